//! Fits the token codec of a model on training scenes: the transform on second moments, the distributions in a second pass,
//! then bits and loss of every count and step on renderings.
// N encoder tokens, S stored tokens, D width

use burn::tensor::Tensor;
use clift_data::{Clip, ClipReader, EvaluationItem, derive_seed, mean};
use clift_model::{
    Histograms, KMeans, Moments, RateTable, SceneModel, TokenCodec, TokenCount, TokenKind, Tokens, TrainedModel,
};

use crate::error::EvalError;
use crate::evaluator::evaluator::Progress;
use crate::sweep::compressed_tokens::{host_values, with_values};
use crate::upload::{upload_cameras, upload_views};

/// Most scenes that transform and distributions are fitted on; each is read twice, with one of the counts.
const MAX_FITTED_SCENES: usize = 64;
/// Most scenes whose renderings are measured, with every count and step.
const MAX_MEASURED_SCENES: usize = 8;
/// Measured steps, as factors of the root mean square deviation of a value.
const STEPS: [f64; 6] = [0.125, 0.25, 0.5, 1.0, 2.0, 4.0];
/// Mean squared error that an exact rendering counts as: 100 dB.
const MIN_ERROR: f64 = 1e-10;

/// Settings of [`fit_codec`].
#[derive(Clone, Debug, PartialEq)]
pub struct CodecOptions {
    /// Token counts that are fitted and measured.
    pub counts: Vec<TokenCount>,
    /// Latent K-means.
    pub kmeans: KMeans,
    /// Seed of K-means; every scene derives a seed of its own.
    pub seed: u64,
}

/// A fitted codec, and the bound of its bits.
#[derive(Clone, Debug)]
pub struct FittedCodec {
    /// The codec.
    pub codec: TokenCodec,
    /// Bits of the measured tokens in their streams, and by the entropy of their levels by direction, at every step.
    pub stream_and_entropy_bits: Vec<[f64; 2]>,
    /// Number of measured values.
    pub num_values: usize,
    /// Number of scenes that the codec was fitted on.
    pub num_scenes: usize,
}

/// Fits the codec of the tokens that `model` stores, on the first scenes of `items`, with contexts and targets of
/// training scenes. Tokens of one scene are in memory at a time.
///
/// # Errors
/// [`EvalError::NoScenes`] without readable scenes, [`EvalError::Interrupted`] when `progress` requests a stop, and the
/// errors of the model.
pub fn fit_codec(
    model: &TrainedModel,
    reader: &ClipReader,
    items: &[EvaluationItem],
    options: &CodecOptions,
    progress: &mut dyn Progress,
) -> Result<FittedCodec, EvalError> {
    let num_fitted = items.len().min(MAX_FITTED_SCENES);
    let measured = &items[..items.len().min(MAX_MEASURED_SCENES)];
    let total = 2 * num_fitted + measured.len();
    let mut fit = Fit { model, reader, options, progress, done: 0, total };
    fit.progress.done(0, total);

    let mut moments = Moments::new(model.config.dim);
    let mut num_scenes = 0;
    for (i, item) in items[..num_fitted].iter().enumerate() {
        if let Some(clip) = fit.read(item)? {
            moments.add(&fit.tokens(&clip, i)?);
            num_scenes += 1;
        }
    }
    if num_scenes == 0 {
        return Err(EvalError::NoScenes { reason: "no training scene for the token codec is readable".into() });
    }
    let transform = moments.transform();
    let mut histograms = Histograms::new(model.config.dim);
    for (i, item) in items[..num_fitted].iter().enumerate() {
        if let Some(clip) = fit.read(item)? {
            histograms.add(&transform, &fit.tokens(&clip, i)?);
        }
    }
    let variances: Vec<f64> = transform.deviations.iter().map(|&deviation| f64::from(deviation).powi(2)).collect();
    let deviation = mean(&variances).unwrap_or_default().sqrt();
    let steps: Vec<f64> = STEPS.iter().map(|factor| factor * deviation).collect();

    let kind = if model.has_condenser { TokenKind::Clift } else { TokenKind::Kmeans };
    let network = (model.config.clone(), kind, model.renderer_hash());
    let unknown = RateTable {
        shares: vec![1.0],
        steps: steps.clone(),
        bits: vec![0.0; steps.len()],
        loss: vec![0.0; steps.len()],
        psnr: vec![0.0],
    };
    let codec = TokenCodec::new(network.clone(), transform, histograms.distributions(), unknown)?;
    let mut rates = Measured::new(options.counts.len(), steps);
    for item in measured {
        if let Some(clip) = fit.read(item)? {
            fit.measure(&clip, &codec, &mut rates)?;
        }
    }
    let table = rates.table()?;
    let codec = TokenCodec::new(network, codec.transform, codec.distributions, table)?;
    let Measured { totals: stream_and_entropy_bits, num_values, .. } = rates;
    Ok(FittedCodec { codec, stream_and_entropy_bits, num_values, num_scenes })
}

struct Fit<'a> {
    model: &'a TrainedModel,
    reader: &'a ClipReader,
    options: &'a CodecOptions,
    progress: &'a mut dyn Progress,
    done: usize,
    total: usize,
}

impl Fit<'_> {
    /// Reads the next scene; `None` for a scene that cannot be read.
    fn read(&mut self, item: &EvaluationItem) -> Result<Option<Clip>, EvalError> {
        if self.progress.is_interrupted() {
            return Err(EvalError::Interrupted { done: self.done, total: self.total });
        }
        self.done += 1;
        let clip = self.reader.read(item.scene, &item.views);
        if let Err(error) = &clip {
            self.progress.skipped(self.reader.source.key(item.scene), &error.to_string());
        }
        self.progress.done(self.done, self.total);
        Ok(clip.ok())
    }

    /// Returns the stored tokens of a scene, `[S, D]`, at one of the counts.
    fn tokens(&self, clip: &Clip, index: usize) -> Result<Vec<f32>, EvalError> {
        let lift = self.model.network.encode(&upload_views(&[&clip.context], &self.model.device)?);
        let count = self.options.counts[index % self.options.counts.len()];
        host_values(&self.stored(&lift, count, clip)?)
    }

    /// Clusters and condenses encoder tokens `[1, N, D]`.
    fn stored(&self, lift: &Tokens, count: TokenCount, clip: &Clip) -> Result<Tokens, EvalError> {
        let [_, num_tokens, _] = lift.dims();
        let seed = derive_seed(self.options.seed, &clip.key);
        let fit = self.options.kmeans.fit(lift.values.clone(), count.of(num_tokens)?, &[seed])?;
        let clusters = fit.clusters.upload(&self.model.device);
        Ok(if self.model.has_condenser {
            self.model.network.compress(lift.clone(), &clusters)
        } else {
            lift.centroids(&clusters)
        })
    }

    /// Adds bits and losses of a scene at every count and step.
    fn measure(&self, clip: &Clip, codec: &TokenCodec, rates: &mut Measured) -> Result<(), EvalError> {
        let device = &self.model.device;
        let lift = self.model.network.encode(&upload_views(&[&clip.context], device)?);
        let cameras = upload_cameras(&[&clip.target], device)?;
        let truth: Vec<f32> = clip.target.images.iter().map(|&value| f32::from(value) / 255.0).collect();
        let render = |tokens: Tokens| -> Result<Vec<f32>, EvalError> {
            let images: Tensor<5> = self.model.network.render(tokens, &cameras); // [1, V, H, W, 3]
            images.into_data().convert::<f32>().try_to_vec().map_err(EvalError::tensor)
        };
        let view_len = truth.len() / clip.target.num_views();
        for (c, &count) in self.options.counts.iter().enumerate() {
            let tokens = self.stored(&lift, count, clip)?;
            let values = host_values(&tokens)?;
            let (num_tokens, exact) = (tokens.dims()[1], render(tokens.clone())?);
            let errors = view_errors(&exact, &truth, view_len);
            let psnr: Vec<f64> = errors.iter().map(|error| -10.0 * error.log10()).collect();
            rates.shares[c].push(num_tokens as f64 / lift.dims()[1] as f64);
            rates.psnr[c].push(mean(&psnr).unwrap_or_default());
            for k in 0..rates.steps.len() {
                let step = rates.steps[k] as f32;
                let bits = codec.count_bits(&values, step)?;
                let rounded = render(with_values(tokens.clone(), codec.round(&values, step)?))?;
                rates.loss[c][k].push(loss(&exact, &rounded, &errors));
                rates.bits[c][k].push(bits[0] / num_tokens as f64);
                rates.totals[k] = [0, 1].map(|i| rates.totals[k][i] + bits[i]);
            }
            rates.num_values += values.len();
        }
        Ok(())
    }
}

/// Mean squared error of every view, at least [`MIN_ERROR`].
pub(crate) fn view_errors(images: &[f32], truth: &[f32], view_len: usize) -> Vec<f64> {
    let error = |(a, b): (&[f32], &[f32])| {
        let sum: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum();
        (sum / view_len as f64).max(MIN_ERROR)
    };
    images.chunks_exact(view_len).zip(truth.chunks_exact(view_len)).map(error).collect()
}

/// Returns the mean loss of PSNR in dB of views whose rendering changes from `exact` to `rounded`. The change counts as
/// independent of the `errors` of the exact rendering, whose squares then add up: the difference of two PSNRs against the
/// true images has the same mean, and more noise.
pub(crate) fn loss(exact: &[f32], rounded: &[f32], errors: &[f64]) -> f64 {
    let changes = view_errors(rounded, exact, exact.len() / errors.len());
    let losses: Vec<f64> =
        changes.iter().zip(errors).map(|(change, error)| 10.0 * (1.0 + (change - MIN_ERROR) / error).log10()).collect();
    mean(&losses).unwrap_or_default()
}

/// Sums of a measurement, by count and step.
struct Measured {
    steps: Vec<f64>,
    shares: Vec<Vec<f64>>,
    psnr: Vec<Vec<f64>>,
    bits: Vec<Vec<Vec<f64>>>,
    loss: Vec<Vec<Vec<f64>>>,
    totals: Vec<[f64; 2]>,
    num_values: usize,
}

impl Measured {
    fn new(counts: usize, steps: Vec<f64>) -> Self {
        let empty = || vec![vec![Vec::new(); steps.len()]; counts];
        Self {
            shares: vec![Vec::new(); counts],
            psnr: vec![Vec::new(); counts],
            bits: empty(),
            loss: empty(),
            totals: vec![[0.0; 2]; steps.len()],
            num_values: 0,
            steps,
        }
    }

    /// Returns the means, in the order of counts.
    fn table(&self) -> Result<RateTable, EvalError> {
        let of = |values: &Vec<f64>| mean(values).unwrap_or(f64::NAN);
        let mut order: Vec<usize> = (0..self.shares.len()).collect();
        order.sort_by(|&a, &b| of(&self.shares[a]).total_cmp(&of(&self.shares[b])));
        order.dedup_by(|a, b| of(&self.shares[*a]) == of(&self.shares[*b]));
        let rows = |values: &[Vec<Vec<f64>>]| order.iter().flat_map(|&c| values[c].iter().map(of)).collect();
        let table = RateTable {
            shares: order.iter().map(|&c| of(&self.shares[c])).collect(),
            steps: self.steps.clone(),
            bits: rows(&self.bits),
            loss: rows(&self.loss),
            psnr: order.iter().map(|&c| of(&self.psnr[c])).collect(),
        };
        Ok(table.new()?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn losses_add_independent_errors() {
        let (exact, truth) = (vec![0.5; 6], vec![0.6, 0.6, 0.6, 0.5, 0.5, 0.5]);
        let errors = view_errors(&exact, &truth, 3);
        assert!((errors[0] - 0.01).abs() < 1e-6 && errors[1] == MIN_ERROR);
        assert_eq!(loss(&exact, &exact, &errors), 0.0);
        // As large a change as the error: half of the views lose 3 dB.
        let rounded = [&[0.4, 0.4, 0.4][..], &exact[3..]].concat();
        assert!((loss(&exact, &rounded, &errors) - 10.0 * 2.0_f64.log10() / 2.0).abs() < 1e-3);
    }
}
