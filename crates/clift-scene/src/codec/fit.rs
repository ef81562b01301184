//! Fits the token codec of a model on training scenes: the transform on second moments and on how much renderings change
//! with every direction, the prediction and the distributions in further passes, then the loss of every count and step on
//! renderings.
// N encoder tokens, S stored tokens, D width

use std::ops::Range;
use std::sync::atomic::{AtomicBool, Ordering};

use burn::tensor::Tensor;
use clift_core::{derive_seed, item_rng, mean};
use clift_data::{Clip, ClipReader, EvaluationItem};
use clift_model::{Cameras, KMeans, ModelError, TokenCount, TokenKind, Tokens, TrainedModel};
use rand::RngExt;

use crate::codec::histogram::Histograms;
use crate::codec::prediction::{NeighbourProducts, Places};
use crate::codec::rates::RateTable;
use crate::codec::token_codec::TokenCodec;
use crate::codec::transform::{Moments, Transform};
use crate::error::SceneError;

/// Most scenes that transform and distributions are fitted on; each is read three times, with one of the counts.
const MAX_FITTED_SCENES: usize = 64;
/// Most scenes whose renderings are measured, with every count and step.
const MAX_MEASURED_SCENES: usize = 8;
/// Measured steps, as factors of the root mean square deviation of a value.
const STEPS: [f64; 6] = [0.0625, 0.125, 0.25, 0.5, 1.0, 2.0];
/// Variance of the noise whose effect on renderings is measured, as a factor of the mean variance of a value; a token has
/// this much, along few directions.
const NOISE: f64 = 2.0;
/// Least weight of a direction, squared, as a share of the largest.
const MIN_WEIGHT: f64 = 1e-4;
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

/// Fits the codec of the tokens that `model` stores, on the first scenes of `items`, with contexts and targets of
/// training scenes. Tokens of one scene are in memory at a time. Returns the codec and the number of scenes that it was fitted on.
///
/// `skipped` gets key and reason of every scene that cannot be read.
pub fn fit_codec(
    model: &TrainedModel,
    reader: &ClipReader,
    items: &[EvaluationItem],
    options: &CodecOptions,
    stop: &AtomicBool,
    skipped: &mut dyn FnMut(&str, &str),
) -> Result<(TokenCodec, usize), SceneError> {
    let fitted = &items[..items.len().min(MAX_FITTED_SCENES)];
    let measured = &items[..items.len().min(MAX_MEASURED_SCENES)];
    let total = 3 * fitted.len() + 2 * measured.len();
    let dim = model.config.dim;
    let mut fit = Fit { model, reader, options, stop, skipped, done: 0, total };

    let mut moments = Moments::new(dim);
    let num_scenes = fit.for_each(fitted, |fit, i, clip| {
        moments.add(&fit.tokens(clip, i)?.0);
        Ok(())
    })?;
    if num_scenes == 0 {
        return Err(SceneError::NoScenes { reason: "no training scene for the token codec is readable".into() });
    }
    let mut transform = moments.transform();
    let mut effects = vec![Vec::new(); direction_groups(dim).len()];
    fit.for_each(measured, |fit, i, clip| fit.add_effects(clip, i, &transform, &mut effects))?;
    transform.weigh(&direction_weights(dim, &effects));
    let mut products = NeighbourProducts::new(dim);
    fit.for_each(fitted, |fit, i, clip| {
        let (tokens, ids) = fit.tokens(clip, i)?;
        products.add(&transform, &tokens, fit.places(&ids, clip));
        Ok(())
    })?;
    let prediction = products.prediction(&transform);
    let mut histograms = Histograms::new(dim);
    fit.for_each(fitted, |fit, i, clip| {
        let (tokens, ids) = fit.tokens(clip, i)?;
        histograms.add(&transform, &prediction, &tokens, fit.places(&ids, clip));
        Ok(())
    })?;
    let deviation = mean_variance(&transform).sqrt();
    if deviation == 0.0 {
        return Err(SceneError::NoScenes { reason: "all tokens of the training scenes are equal".into() });
    }
    let steps: Vec<f64> = STEPS.iter().map(|factor| factor * deviation).collect();

    let kind = if model.has_condenser { TokenKind::Clift } else { TokenKind::Kmeans };
    let network = (model.config.clone(), kind, model.renderer_hash());
    let unknown = RateTable { shares: vec![1.0], steps: steps.clone(), loss: vec![0.0; steps.len()] };
    let codec = TokenCodec::new(network.clone(), (transform, prediction), histograms.distributions(), unknown)?;
    let mut rates = Vec::new();
    fit.for_each(measured, |fit, _, clip| {
        rates.push(fit.measure(clip, &codec, &steps)?);
        Ok(())
    })?;
    if rates.is_empty() {
        let reason = format!("none of the first {} training scenes is readable", measured.len());
        return Err(SceneError::NoScenes { reason });
    }
    let codec =
        TokenCodec::new(network, (codec.transform, codec.prediction), codec.distributions, rate_table(steps, &rates)?)?;
    Ok((codec, num_scenes))
}

struct Fit<'a> {
    model: &'a TrainedModel,
    reader: &'a ClipReader,
    options: &'a CodecOptions,
    stop: &'a AtomicBool,
    skipped: &'a mut dyn FnMut(&str, &str),
    done: usize,
    total: usize,
}

impl Fit<'_> {
    /// Reads scenes and calls `add` with those that can be read; returns their number.
    fn for_each(
        &mut self,
        items: &[EvaluationItem],
        mut add: impl FnMut(&Self, usize, &Clip) -> Result<(), SceneError>,
    ) -> Result<usize, SceneError> {
        let mut num_read = 0;
        for (i, item) in items.iter().enumerate() {
            if self.stop.load(Ordering::Relaxed) {
                return Err(SceneError::Interrupted { done: self.done, total: self.total });
            }
            self.done += 1;
            match self.reader.read(item.scene, &item.views) {
                Ok(clip) => {
                    add(self, i, &clip)?;
                    num_read += 1;
                }
                Err(error) => (self.skipped)(self.reader.source.key(item.scene), &error.to_string()),
            }
        }
        Ok(num_read)
    }

    fn lift(&self, clip: &Clip) -> Result<Tokens, SceneError> {
        Ok(self.model.network.encode(&self.model.upload(&clip.context, &self.options.counts)?))
    }

    /// Returns the stored tokens of a scene, `[S, D]`, at one of the counts, and their patches.
    fn tokens(&self, clip: &Clip, index: usize) -> Result<(Vec<f32>, Vec<u32>), SceneError> {
        let count = self.options.counts[index % self.options.counts.len()];
        let (tokens, ids) = self.stored(&self.lift(clip)?, count, clip)?;
        Ok((tokens.to_host()?, ids))
    }

    fn places<'a>(&self, ids: &'a [u32], clip: &Clip) -> Places<'a> {
        let [rows, columns] = [clip.context.height, clip.context.width].map(|side| side / self.model.config.patch_size);
        Places { ids, grid: [clip.context.num_views(), rows, columns] }
    }

    /// Clusters and condenses encoder tokens `[1, N, D]`; returns the tokens and their patches.
    fn stored(&self, lift: &Tokens, count: TokenCount, clip: &Clip) -> Result<(Tokens, Vec<u32>), SceneError> {
        let [_, num_tokens, _] = lift.dims();
        let seed = derive_seed(self.options.seed, &clip.key);
        // A scene of fewer tokens stores all of them.
        let count = count.of(num_tokens).unwrap_or(num_tokens);
        let fit = self.options.kmeans.fit(lift.values.clone(), count, &[seed])?;
        let ids = fit.clusters.scenes()[0].centroid_index().to_vec();
        let clusters = fit.clusters.upload(&self.model.device);
        let tokens = if self.model.has_condenser {
            self.model.network.compress(lift.clone(), &clusters)
        } else {
            lift.centroids(&clusters)
        };
        Ok((tokens, ids))
    }

    fn render(&self, tokens: Tokens, cameras: &Cameras) -> Result<Vec<f32>, SceneError> {
        let images: Tensor<5> = self.model.network.render(tokens, cameras); // [1, V, H, W, 3]
        images.into_data().convert::<f32>().try_to_vec().map_err(|error| ModelError::device(error).into())
    }

    /// Adds the mean squared change of renderings of a scene, at one of the counts, by noise along each group of directions.
    fn add_effects(
        &self,
        clip: &Clip,
        index: usize,
        transform: &Transform,
        effects: &mut [Vec<f64>],
    ) -> Result<(), SceneError> {
        let cameras = Cameras::upload(&[&clip.target], &self.model.device)?;
        let (tokens, _) =
            self.stored(&self.lift(clip)?, self.options.counts[index % self.options.counts.len()], clip)?;
        let (values, exact) = (tokens.to_host()?, self.render(tokens.clone(), &cameras)?);
        let dim = transform.mean.len();
        let mut rng = item_rng(self.options.seed, index as u64, 0, 0, "codec noise");
        for (group, effects) in direction_groups(dim).into_iter().zip(effects) {
            let deviation = (NOISE * mean_variance(transform) / group.len() as f64).sqrt();
            let mut noisy = values.clone();
            for token in noisy.chunks_exact_mut(dim) {
                for direction in group.clone() {
                    // Even noise, of this deviation.
                    let noise = (rng.random_range(-1.0..1.0) * deviation * 3.0_f64.sqrt()) as f32;
                    token.iter_mut().zip(transform.direction(direction)).for_each(|(value, x)| *value += noise * x);
                }
            }
            let changed = self.render(tokens.with_host_values(noisy), &cameras)?;
            effects.push(view_errors(&changed, &exact, exact.len())[0]);
        }
        Ok(())
    }

    fn measure(&self, clip: &Clip, codec: &TokenCodec, steps: &[f64]) -> Result<Rates, SceneError> {
        let (lift, cameras) = (self.lift(clip)?, Cameras::upload(&[&clip.target], &self.model.device)?);
        let truth: Vec<f32> = clip.target.images.iter().map(|&value| f32::from(value) / 255.0).collect();
        let view_len = truth.len() / clip.target.num_views();
        let mut rates = Rates::default();
        for &count in &self.options.counts {
            let (tokens, ids) = self.stored(&lift, count, clip)?;
            let (places, values) = (self.places(&ids, clip), tokens.to_host()?);
            let exact = self.render(tokens.clone(), &cameras)?;
            let errors = view_errors(&exact, &truth, view_len);
            rates[0].push(tokens.dims()[1] as f64 / lift.dims()[1] as f64);
            for &step in steps {
                let rounded = tokens.with_host_values(codec.round(&values, places, step as f32)?);
                rates[1].push(loss(&exact, &self.render(rounded, &cameras)?, &errors));
            }
        }
        Ok(rates)
    }
}

/// Shares of all tokens by count, and losses by count and step.
type Rates = [Vec<f64>; 2];

/// Returns the groups of neighbouring directions that noise is added to: single ones, then two per doubling.
fn direction_groups(dim: usize) -> Vec<Range<usize>> {
    let starts = (0..).map(|i: u32| if i < 4 { i as usize } else { (2 + i as usize % 2) << (i / 2 - 1) });
    let starts: Vec<usize> = starts.take_while(|start| *start < dim).chain([dim]).collect();
    starts.windows(2).map(|pair| pair[0]..pair[1]).collect()
}

/// Returns the weight of every direction: the root of its group's mean effect, 1 for the largest.
fn direction_weights(dim: usize, effects: &[Vec<f64>]) -> Vec<f32> {
    let means: Vec<f64> = effects.iter().map(|effects| mean(effects).unwrap_or(1.0)).collect();
    let largest = means.iter().copied().fold(f64::MIN_POSITIVE, f64::max);
    let weight = |effect: f64| (effect / largest).max(MIN_WEIGHT).sqrt() as f32;
    let groups = direction_groups(dim).into_iter().zip(means);
    groups.flat_map(|(group, effect)| vec![weight(effect); group.len()]).collect()
}

fn mean_variance(transform: &Transform) -> f64 {
    let variances: Vec<f64> = transform.deviations.iter().map(|&deviation| f64::from(deviation).powi(2)).collect();
    mean(&variances).unwrap_or_default()
}

/// Mean squared error of every view, at least [`MIN_ERROR`].
fn view_errors(images: &[f32], truth: &[f32], view_len: usize) -> Vec<f64> {
    let error = |(a, b): (&[f32], &[f32])| {
        let sum: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum();
        (sum / view_len as f64).max(MIN_ERROR)
    };
    images.chunks_exact(view_len).zip(truth.chunks_exact(view_len)).map(error).collect()
}

/// Returns the mean loss of PSNR in dB of views whose rendering changes from `exact` to `rounded`. The change counts as
/// independent of the `errors` of the exact rendering, whose squares then add up: the difference of two PSNRs against the
/// true images has the same mean, and more noise.
fn loss(exact: &[f32], rounded: &[f32], errors: &[f64]) -> f64 {
    let changes = view_errors(rounded, exact, exact.len() / errors.len());
    let losses: Vec<f64> =
        changes.iter().zip(errors).map(|(change, error)| 10.0 * (1.0 + (change - MIN_ERROR) / error).log10()).collect();
    mean(&losses).unwrap_or_default()
}

/// Returns the means over scenes, in the order of counts.
fn rate_table(steps: Vec<f64>, scenes: &[Rates]) -> Result<RateTable, ModelError> {
    let mean_of = |part: usize| -> Vec<f64> {
        let values = |i: usize| scenes.iter().map(|rates| rates[part][i]).collect::<Vec<f64>>();
        (0..scenes[0][part].len()).map(|i| mean(&values(i)).unwrap_or(f64::NAN)).collect()
    };
    let [shares, loss] = [0, 1].map(mean_of);
    let mut order: Vec<usize> = (0..shares.len()).collect();
    order.sort_by(|&a, &b| shares[a].total_cmp(&shares[b]));
    order.dedup_by(|a, b| shares[*a] == shares[*b]);
    let loss = order.iter().flat_map(|&c| &loss[c * steps.len()..][..steps.len()]).copied().collect();
    RateTable { shares: order.iter().map(|&c| shares[c]).collect(), loss, steps }.checked()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_cover_all_directions_and_weights_follow_effects() {
        let groups = direction_groups(40);
        let starts: Vec<usize> = groups.iter().map(|group| group.start).collect();
        assert_eq!(starts, [0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32]);
        assert_eq!(groups.last().unwrap().end, 40);
        assert_eq!(direction_groups(1).len(), 1);
        let weights = direction_weights(3, &[vec![0.5, 0.3], vec![0.1], vec![0.0]]);
        assert_eq!(weights, [1.0, 0.5, 0.01]);
    }

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
