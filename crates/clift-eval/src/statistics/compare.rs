//! Comparison of two evaluations: differences of the same views, scene by scene.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clift_core::{mean, standard_error};
use serde::{Deserialize, Serialize};

use crate::error::EvalError;
use crate::statistics::student_t::t_quantile_95;
use crate::statistics::view_metrics::PSNR_CAP_DB;

const METRICS: [&str; 3] = ["psnr", "ssim", "lpips_vgg"];

/// The key of a row of `views.csv`, as text.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct RowKey {
    /// Name of the method.
    pub method: String,
    /// Tokens in the scene file.
    pub num_storage_tokens: usize,
    /// Tokens of a rendering.
    pub num_render_tokens: usize,
    /// Number format of the stored tokens; empty without tokens.
    pub tokens: String,
}

/// The compared columns of `views.csv`.
#[derive(Deserialize)]
struct Row {
    scene: String,
    target_frame: usize,
    method: String,
    num_storage_tokens: usize,
    num_render_tokens: usize,
    psnr: Option<f64>,
    ssim: Option<f64>,
    lpips_vgg: Option<f64>,
    tokens: String,
}

/// Scene and target frame.
type View = (String, usize);
type Values = [Option<f64>; METRICS.len()];

/// The metrics of every view of an evaluation.
#[derive(Clone, Debug, PartialEq)]
pub struct Evaluation {
    path: PathBuf,
    views: BTreeMap<RowKey, BTreeMap<View, Values>>,
}

impl Evaluation {
    /// Reads `views.csv` from a run, from the folder of an evaluation, or from the path of the file.
    ///
    /// # Errors
    /// [`EvalError::NotComparable`] without `views.csv`, or for a file of another format.
    pub fn read(path: &Path) -> Result<Self, EvalError> {
        let candidates = [path.join("views.csv"), path.join("eval").join("views.csv"), path.to_owned()];
        let Some(file) = candidates.into_iter().find(|candidate| candidate.is_file()) else {
            let reason = "no views.csv here or in `eval`; `clift eval` writes the file".into();
            return Err(EvalError::NotComparable { reason, path: path.into() });
        };
        let bad = |error: csv::Error| EvalError::NotComparable { reason: error.to_string(), path: file.clone() };
        let mut views: BTreeMap<RowKey, BTreeMap<View, Values>> = BTreeMap::new();
        for row in csv::Reader::from_path(&file).map_err(bad)?.deserialize() {
            let row: Row = row.map_err(bad)?;
            let key = RowKey {
                method: row.method,
                num_storage_tokens: row.num_storage_tokens,
                num_render_tokens: row.num_render_tokens,
                tokens: row.tokens,
            };
            let psnr = row.psnr.map(|psnr| psnr.min(PSNR_CAP_DB));
            views.entry(key).or_default().insert((row.scene, row.target_frame), [psnr, row.ssim, row.lpips_vgg]);
        }
        Ok(Self { path: path.into(), views })
    }
}

/// One side of a comparison of methods.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MethodFilter {
    /// The method.
    pub method: String,
    /// The number format; `None` for any format.
    pub tokens: Option<String>,
}

impl MethodFilter {
    /// Parses `method` or `method:format`.
    pub fn parse(text: &str) -> Self {
        match text.split_once(':') {
            Some((method, tokens)) => Self { method: method.into(), tokens: Some(tokens.into()) },
            None => Self { method: text.into(), tokens: None },
        }
    }

    fn matches(&self, key: &RowKey) -> bool {
        key.method == self.method && self.tokens.as_ref().is_none_or(|tokens| *tokens == key.tokens)
    }
}

/// The paired difference of one metric.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct MetricDifference {
    /// Mean over scenes of the first evaluation.
    pub a: f64,
    /// Mean over scenes of the second evaluation.
    pub b: f64,
    /// Mean over scenes of the second minus the first.
    pub mean: f64,
    /// Standard error of `mean`; null for a single scene.
    pub stderr: Option<f64>,
    /// Ends of the 95 % confidence interval of `mean`, from Student's t distribution; null for a single scene.
    pub interval: Option<[f64; 2]>,
}

/// The differences between two keys.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PairedRow {
    /// Key in the first evaluation.
    pub a: RowKey,
    /// Key in the second evaluation.
    pub b: RowKey,
    /// Scenes with a common view.
    pub num_scenes: usize,
    /// Common views.
    pub num_views: usize,
    /// Ignored views of the first evaluation, missing in the second.
    pub num_only_a: usize,
    /// Ignored views of the second evaluation, missing in the first.
    pub num_only_b: usize,
    /// Difference of PSNR in dB; an identical image counts as 100 dB.
    pub psnr: Option<MetricDifference>,
    /// Difference of SSIM.
    pub ssim: Option<MetricDifference>,
    /// Difference of LPIPS; lower is better.
    pub lpips_vgg: Option<MetricDifference>,
}

/// A comparison of two evaluations.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    /// Path of the first evaluation.
    pub a: PathBuf,
    /// Path of the second evaluation.
    pub b: PathBuf,
    /// One row per common key.
    pub pairs: Vec<PairedRow>,
    /// Keys of the first evaluation without a row.
    pub only_a: Vec<RowKey>,
    /// Keys of the second evaluation without a row.
    pub only_b: Vec<RowKey>,
}

impl Comparison {
    /// Compares all common keys, or one method of the first with one method of the second at equal token counts.
    ///
    /// Differences are between the same target frames of the same scenes: means over the views of a scene, then over the
    /// scenes. Views of only one evaluation are ignored and counted.
    ///
    /// # Errors
    /// [`EvalError::NotComparable`] without a common key or without a common view.
    pub fn new(a: &Evaluation, b: &Evaluation, sides: Option<&[MethodFilter; 2]>) -> Result<Self, EvalError> {
        let mut pairs = Vec::new();
        for (key_a, views_a) in &a.views {
            for (key_b, views_b) in &b.views {
                let matches = match sides {
                    None => key_a == key_b,
                    Some([side_a, side_b]) => {
                        let counts = |key: &RowKey| (key.num_storage_tokens, key.num_render_tokens);
                        side_a.matches(key_a) && side_b.matches(key_b) && counts(key_a) == counts(key_b)
                    }
                };
                if matches {
                    pairs.push(PairedRow::new((key_a, views_a), (key_b, views_b)));
                }
            }
        }
        let not_comparable = |reason: String| EvalError::NotComparable { reason, path: b.path.clone() };
        if pairs.is_empty() {
            let keys = |of: &Evaluation| of.views.keys().map(RowKey::to_string).collect::<Vec<_>>().join(", ");
            let path = a.path.display();
            let reason = format!("no common method and token count: {path} has {}; the other has {}", keys(a), keys(b));
            return Err(not_comparable(reason));
        }
        if pairs.iter().all(|pair| pair.num_views == 0) {
            let first = |evaluation: &Evaluation| {
                let view = evaluation.views.values().flat_map(BTreeMap::keys).next();
                view.map_or_else(String::new, |(scene, frame)| format!("{scene}, frame {frame}"))
            };
            return Err(not_comparable(format!(
                "no common target view: {} starts with {}, the other with {}; evaluate both with the same index",
                a.path.display(),
                first(a),
                first(b)
            )));
        }
        // Methods that are not asked for are left out on purpose.
        let without_row = |of: &Evaluation, side: fn(&PairedRow) -> &RowKey| -> Vec<RowKey> {
            let keys = of.views.keys().filter(|_| sides.is_none());
            keys.filter(|key| !pairs.iter().any(|pair| side(pair) == *key)).cloned().collect()
        };
        let (only_a, only_b) = (without_row(a, |pair| &pair.a), without_row(b, |pair| &pair.b));
        Ok(Self { a: a.path.clone(), b: b.path.clone(), pairs, only_a, only_b })
    }
}

impl PairedRow {
    fn new((key_a, a): (&RowKey, &BTreeMap<View, Values>), (key_b, b): (&RowKey, &BTreeMap<View, Values>)) -> Self {
        let common: Vec<(&View, &Values, &Values)> =
            a.iter().filter_map(|(view, values)| Some((view, values, b.get(view)?))).collect();
        let scenes: Vec<_> = common.chunk_by(|(a, ..), (b, ..)| a.0 == b.0).collect();
        let difference = |metric: usize| {
            // Only views with the metric in both evaluations count.
            let scene_means = scenes.iter().filter_map(|views| {
                let values: Vec<(f64, f64)> =
                    views.iter().filter_map(|(_, a, b)| Some((a[metric]?, b[metric]?))).collect();
                let count = values.len() as f64;
                let sum = values.iter().fold((0.0, 0.0), |sum, value| (sum.0 + value.0, sum.1 + value.1));
                (!values.is_empty()).then(|| (sum.0 / count, sum.1 / count))
            });
            MetricDifference::of(&scene_means.collect::<Vec<_>>())
        };
        Self {
            a: key_a.clone(),
            b: key_b.clone(),
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

impl MetricDifference {
    /// Computes the difference from one pair of values per scene; `None` without scenes.
    fn of(pairs: &[(f64, f64)]) -> Option<Self> {
        let means = |value: fn(&(f64, f64)) -> f64| {
            let values: Vec<f64> = pairs.iter().map(value).collect();
            Some((mean(&values)?, standard_error(&values)))
        };
        let ((a, _), (b, _), (difference, stderr)) =
            (means(|pair| pair.0)?, means(|pair| pair.1)?, means(|pair| pair.1 - pair.0)?);
        let interval = stderr.map(|stderr| {
            let half = t_quantile_95(pairs.len() - 1) * stderr;
            [difference - half, difference + half]
        });
        Some(Self { a, b, mean: difference, stderr, interval })
    }

    /// Returns whether the confidence interval excludes zero.
    pub fn is_clear(&self) -> bool {
        self.interval.is_some_and(|[low, high]| low > 0.0 || high < 0.0)
    }
}

#[cfg(test)]
mod tests;
