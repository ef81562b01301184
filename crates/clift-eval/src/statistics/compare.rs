//! Two evaluations side by side: differences of the same views, scene by scene.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::error::EvalError;
use crate::statistics::scene_means::capped;
use crate::statistics::student_t::t_quantile_95;

/// What both evaluations measure.
const METRICS: [&str; 3] = ["psnr", "ssim", "lpips_vgg"];

/// How a line of `views.csv` was made.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct RowKey {
    /// Its variant.
    pub variant: String,
    /// Tokens in the scene file.
    pub num_storage_tokens: usize,
    /// Tokens the renderer was given.
    pub num_render_tokens: usize,
    /// Number format of the stored tokens; empty where there are none.
    pub tokens: String,
}

/// A row of `views.csv`, as far as it is compared.
#[derive(Deserialize)]
struct Row {
    scene: String,
    target_frame: usize,
    variant: String,
    num_storage_tokens: usize,
    num_render_tokens: usize,
    psnr: Option<f64>,
    ssim: Option<f64>,
    lpips_vgg: Option<f64>,
    #[serde(default)]
    tokens: String,
}

/// Scene and target frame.
type View = (String, usize);
type Values = [Option<f64>; METRICS.len()];

/// What an evaluation measured of every view.
#[derive(Clone, Debug, PartialEq)]
pub struct Evaluation {
    path: PathBuf,
    views: BTreeMap<RowKey, BTreeMap<View, Values>>,
}

impl Evaluation {
    /// Reads the `views.csv` of a run, of an evaluation's folder, or itself.
    ///
    /// # Errors
    /// [`EvalError::NotComparable`] where there is none, or it is not one.
    pub fn read(path: &Path) -> Result<Self, EvalError> {
        let candidates = [path.join("views.csv"), path.join("eval").join("views.csv"), path.to_owned()];
        let Some(file) = candidates.into_iter().find(|candidate| candidate.is_file()) else {
            let reason = "there is no views.csv, and none in `eval`; `clift eval` writes it".into();
            return Err(EvalError::NotComparable { reason, path: path.into() });
        };
        let bad = |error: csv::Error| EvalError::NotComparable { reason: error.to_string(), path: file.clone() };
        let mut views: BTreeMap<RowKey, BTreeMap<View, Values>> = BTreeMap::new();
        for row in csv::Reader::from_path(&file).map_err(bad)?.deserialize() {
            let row: Row = row.map_err(bad)?;
            let made = RowKey {
                variant: row.variant,
                num_storage_tokens: row.num_storage_tokens,
                num_render_tokens: row.num_render_tokens,
                tokens: row.tokens,
            };
            let psnr = row.psnr.map(capped);
            views.entry(made).or_default().insert((row.scene, row.target_frame), [psnr, row.ssim, row.lpips_vgg]);
        }
        Ok(Self { path: path.into(), views })
    }
}

/// One of the two sides of a comparison by variants.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MethodFilter {
    /// The variant.
    pub variant: String,
    /// The number format; any, if there is only one, where it is not given.
    pub tokens: Option<String>,
}

impl MethodFilter {
    /// Reads `variant` or `variant:format`.
    pub fn parse(text: &str) -> Self {
        match text.split_once(':') {
            Some((variant, tokens)) => Self { variant: variant.into(), tokens: Some(tokens.into()) },
            None => Self { variant: text.into(), tokens: None },
        }
    }

    fn holds(&self, made: &RowKey) -> bool {
        made.variant == self.variant && self.tokens.as_ref().is_none_or(|tokens| *tokens == made.tokens)
    }
}

/// The difference of one metric.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PairedDifference {
    /// Mean over the scenes of the first.
    pub a: f64,
    /// Mean over the scenes of the second.
    pub b: f64,
    /// Mean over scenes of second minus first.
    pub mean: f64,
    /// Standard error of `mean`; null for a single scene.
    pub stderr: Option<f64>,
    /// Ends of the 95 % confidence interval of `mean`, from Student's t distribution; null for a single scene.
    pub interval: Option<[f64; 2]>,
}

/// The differences between two settings.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PairedRow {
    /// How the first was made.
    pub a: RowKey,
    /// How the second was made.
    pub b: RowKey,
    /// Scenes with a view of both.
    pub num_scenes: usize,
    /// Views of both.
    pub num_views: usize,
    /// Views of the first alone, which are left out.
    pub num_only_a: usize,
    /// Views of the second alone, which are left out.
    pub num_only_b: usize,
    /// In dB; an identical picture counts as 100.
    pub psnr: Option<PairedDifference>,
    /// Of SSIM.
    pub ssim: Option<PairedDifference>,
    /// Of LPIPS, where less is better.
    pub lpips_vgg: Option<PairedDifference>,
}

/// Two evaluations side by side.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    /// Where the first lies.
    pub a: PathBuf,
    /// Where the second lies.
    pub b: PathBuf,
    /// One per setting of both.
    pub pairs: Vec<PairedRow>,
}

impl Comparison {
    /// Compares every setting that both have, or one variant of the first with one of the second at equal counts.
    ///
    /// Differences are of the same target frames of the same scenes: first the mean of each scene's views, then over
    /// scenes. Views that only one side has are left out and counted.
    ///
    /// # Errors
    /// [`EvalError::NotComparable`] without a common setting, or without a common view of any.
    pub fn new(a: &Evaluation, b: &Evaluation, sides: Option<&[MethodFilter; 2]>) -> Result<Self, EvalError> {
        let mut pairs = Vec::new();
        for (made_a, views_a) in &a.views {
            for (made_b, views_b) in &b.views {
                let matches = match sides {
                    None => made_a == made_b,
                    Some([side_a, side_b]) => {
                        let counts = |made: &RowKey| (made.num_storage_tokens, made.num_render_tokens);
                        side_a.holds(made_a) && side_b.holds(made_b) && counts(made_a) == counts(made_b)
                    }
                };
                if matches {
                    pairs.push(PairedRow::new((made_a, views_a), (made_b, views_b)));
                }
            }
        }
        let not = |reason: String| EvalError::NotComparable { reason, path: b.path.clone() };
        if pairs.is_empty() {
            let of = |evaluation: &Evaluation| {
                let made = evaluation.views.keys().map(RowKey::to_string);
                made.collect::<Vec<_>>().join(", ")
            };
            return Err(not(format!(
                "no setting is in both: {} has {}; the other has {}",
                a.path.display(),
                of(a),
                of(b)
            )));
        }
        if pairs.iter().all(|pair| pair.num_views == 0) {
            let first = |evaluation: &Evaluation| {
                let view = evaluation.views.values().flat_map(BTreeMap::keys).next();
                view.map_or_else(String::new, |(scene, frame)| format!("{scene}, frame {frame}"))
            };
            return Err(not(format!(
                "no target view is in both: {} begins with {}, the other with {}; evaluate both with one index",
                a.path.display(),
                first(a),
                first(b)
            )));
        }
        Ok(Self { a: a.path.clone(), b: b.path.clone(), pairs })
    }
}

impl PairedRow {
    fn new((made_a, a): (&RowKey, &BTreeMap<View, Values>), (made_b, b): (&RowKey, &BTreeMap<View, Values>)) -> Self {
        let common: Vec<(&View, &Values, &Values)> =
            a.iter().filter_map(|(view, values)| Some((view, values, b.get(view)?))).collect();
        let scenes: Vec<_> = common.chunk_by(|(a, ..), (b, ..)| a.0 == b.0).collect();
        let difference = |metric: usize| {
            // A view counts where both have the metric.
            let scene_means = scenes.iter().filter_map(|views| {
                let values: Vec<(f64, f64)> =
                    views.iter().filter_map(|(_, a, b)| Some((a[metric]?, b[metric]?))).collect();
                let count = values.len() as f64;
                let sum = values.iter().fold((0.0, 0.0), |sum, value| (sum.0 + value.0, sum.1 + value.1));
                (!values.is_empty()).then(|| (sum.0 / count, sum.1 / count))
            });
            PairedDifference::of(&scene_means.collect::<Vec<_>>())
        };
        Self {
            a: made_a.clone(),
            b: made_b.clone(),
            num_scenes: scenes.len(),
            num_views: common.len(),
            num_only_a: a.len() - common.len(),
            num_only_b: b.len() - common.len(),
            psnr: difference(0),
            ssim: difference(1),
            lpips_vgg: difference(2),
        }
    }
}

impl PairedDifference {
    /// Of paired values, one pair per scene.
    fn of(pairs: &[(f64, f64)]) -> Option<Self> {
        let count = pairs.len() as f64;
        let mean = |value: &dyn Fn(&(f64, f64)) -> f64| pairs.iter().map(value).sum::<f64>() / count;
        let (a, b, difference) = (mean(&|pair| pair.0), mean(&|pair| pair.1), mean(&|pair| pair.1 - pair.0));
        let squares: f64 = pairs.iter().map(|(a, b)| (b - a - difference).powi(2)).sum();
        let stderr = (pairs.len() > 1).then(|| (squares / (count - 1.0) / count).sqrt());
        let interval = stderr.map(|stderr| {
            let half = t_quantile_95(pairs.len() - 1) * stderr;
            [difference - half, difference + half]
        });
        (!pairs.is_empty()).then_some(Self { a, b, mean: difference, stderr, interval })
    }

    /// Whether the confidence interval does not hold zero.
    pub fn is_clear(&self) -> bool {
        self.interval.is_some_and(|[low, high]| low > 0.0 || high < 0.0)
    }
}

#[cfg(test)]
mod tests;
