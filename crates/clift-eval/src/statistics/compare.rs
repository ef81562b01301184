//! Comparison of two evaluations: differences of the same views, scene by scene.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clift_scene::TokenCoding;
use serde::Serialize;

use crate::config::method::Method;
use crate::error::EvalError;
use crate::statistics::csv_files::read_views;
use crate::statistics::eval_results::{EvalResults, SceneViews};
use crate::statistics::metric_difference::{MetricDifference, common_views};
use crate::statistics::view_metrics::{EvalKey, LPIPS, PSNR, SHARPNESS, SSIM};

/// The metrics of every view of an evaluation.
#[derive(Clone, Debug)]
pub struct Evaluation {
    path: PathBuf,
    results: EvalResults,
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
        Ok(Self { path: path.into(), results: read_views(&file)? })
    }

    fn keys(&self) -> impl Iterator<Item = EvalKey> {
        self.results.views().map(|(key, _)| key)
    }
}

/// One side of a comparison of methods.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MethodFilter {
    method: Method,
    /// The number format; `None` for any format.
    tokens: Option<TokenCoding>,
}

impl MethodFilter {
    /// Parses `method` or `method:format`.
    ///
    /// # Errors
    /// [`EvalError::BadMethodName`], and [`EvalError::Model`] for an unknown format.
    pub fn parse(text: &str) -> Result<Self, EvalError> {
        let (method, tokens) = text.split_once(':').map_or((text, None), |(method, tokens)| (method, Some(tokens)));
        Ok(Self { method: method.parse()?, tokens: tokens.map(str::parse).transpose()? })
    }

    fn matches(&self, key: EvalKey) -> bool {
        key.method == self.method && (self.tokens.is_none() || self.tokens == key.tokens)
    }
}

/// The differences between two keys.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PairedRow {
    /// Key in the first evaluation.
    pub a: EvalKey,
    /// Key in the second evaluation.
    pub b: EvalKey,
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
    /// Difference of sharpness.
    pub sharpness: Option<MetricDifference>,
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
    pub only_a: Vec<EvalKey>,
    /// Keys of the second evaluation without a row.
    pub only_b: Vec<EvalKey>,
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
        for (key_a, views_a) in a.results.views() {
            for (key_b, views_b) in b.results.views() {
                let matches = match sides {
                    None => key_a == key_b,
                    Some([side_a, side_b]) => {
                        let counts = |key: EvalKey| (key.num_storage_tokens, key.num_render_tokens);
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
            let keys = |of: &Evaluation| of.keys().map(|key| key.to_string()).collect::<Vec<_>>().join(", ");
            let path = a.path.display();
            let reason = format!("no common method and token count: {path} has {}; the other has {}", keys(a), keys(b));
            return Err(not_comparable(reason));
        }
        if pairs.iter().all(|pair| pair.num_views == 0) {
            let first = |evaluation: &Evaluation| {
                let mut scenes = evaluation.results.views().flat_map(|(_, scenes)| scenes);
                let view = scenes.find_map(|(scene, frames)| Some((scene, frames.keys().next()?)));
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
        let without_row = |of: &Evaluation, side: fn(&PairedRow) -> EvalKey| -> Vec<EvalKey> {
            let keys = of.keys().filter(|_| sides.is_none());
            keys.filter(|key| !pairs.iter().any(|pair| side(pair) == *key)).collect()
        };
        let (only_a, only_b) = (without_row(a, |pair| pair.a), without_row(b, |pair| pair.b));
        Ok(Self { a: a.path.clone(), b: b.path.clone(), pairs, only_a, only_b })
    }
}

impl PairedRow {
    fn new((key_a, a): (EvalKey, &SceneViews), (key_b, b): (EvalKey, &SceneViews)) -> Self {
        let common = common_views(a, b);
        let num_views = common.iter().map(Vec::len).sum();
        let num_other = |views: &SceneViews| views.values().map(BTreeMap::len).sum::<usize>() - num_views;
        Self {
            a: key_a,
            b: key_b,
            num_scenes: common.len(),
            num_views,
            num_only_a: num_other(a),
            num_only_b: num_other(b),
            psnr: MetricDifference::new(&common, PSNR),
            ssim: MetricDifference::new(&common, SSIM),
            lpips_vgg: MetricDifference::new(&common, LPIPS),
            sharpness: MetricDifference::new(&common, SHARPNESS),
        }
    }
}

#[cfg(test)]
mod tests;
