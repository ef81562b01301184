//! Comparison of two evaluations: differences of the same views, scene by scene.

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::error::EvalError;
use crate::statistics::csv_files::read_views;
use crate::statistics::eval_results::{EvalResults, SceneViews};
use crate::statistics::metric_difference::{MetricDifference, common_views};
use crate::statistics::text_table::table;
use crate::statistics::view_metrics::{EvalKey, METRICS};

/// The metrics of every view of an evaluation.
#[derive(Clone, Debug)]
pub struct Evaluation {
    path: PathBuf,
    results: EvalResults,
}

impl Evaluation {
    /// Reads `views.csv` from a run, from the folder of an evaluation, or from the path of the file.
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

/// The differences of one key.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PairedRow {
    pub key: EvalKey,
    pub num_scenes: usize,
    pub num_views: usize,
    /// Views that the other evaluation does not have: ignored.
    pub num_only_a: usize,
    pub num_only_b: usize,
    /// In dB; an identical image counts as 100 dB.
    pub psnr: Option<MetricDifference>,
    pub ssim: Option<MetricDifference>,
    pub lpips_vgg: Option<MetricDifference>,
    pub sharpness: Option<MetricDifference>,
}

/// A comparison of two evaluations.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    a: PathBuf,
    b: PathBuf,
    pairs: Vec<PairedRow>,
    /// Keys of either evaluation without a row.
    only_a: Vec<EvalKey>,
    only_b: Vec<EvalKey>,
}

impl Comparison {
    /// Compares all common keys.
    ///
    /// Differences are between the same target frames of the same scenes: means over the views of a scene, then over the
    /// scenes. Views of only one evaluation are ignored and counted.
    ///
    /// # Errors
    /// [`EvalError::NotComparable`] without a common key or without a common view.
    pub fn new(a: &Evaluation, b: &Evaluation) -> Result<Self, EvalError> {
        let rows = |(key, views)| Some(PairedRow::new(key, views, b.results.of(key)?));
        let pairs: Vec<PairedRow> = a.results.views().filter_map(rows).collect();
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
        let only_in = |of: &Evaluation, other: &Evaluation| -> Vec<EvalKey> {
            of.keys().filter(|key| other.results.of(*key).is_none()).collect()
        };
        let (only_a, only_b) = (only_in(a, b), only_in(b, a));
        Ok(Self { a: a.path.clone(), b: b.path.clone(), pairs, only_a, only_b })
    }
}

impl PairedRow {
    fn new(key: EvalKey, a: &SceneViews, b: &SceneViews) -> Self {
        let common = common_views(a, b);
        let num_views = common.iter().map(Vec::len).sum();
        let num_other = |views: &SceneViews| views.values().map(BTreeMap::len).sum::<usize>() - num_views;
        let [psnr, ssim, lpips_vgg, sharpness] = METRICS.map(|metric| MetricDifference::new(&common, metric));
        let (num_only_a, num_only_b) = (num_other(a), num_other(b));
        let num_scenes = common.len();
        Self { key, num_scenes, num_views, num_only_a, num_only_b, psnr, ssim, lpips_vgg, sharpness }
    }
}

impl fmt::Display for Comparison {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "A: {}\nB: {}\n", self.a.display(), self.b.display())?;
        let metrics = ["dB", "SSIM", "LPIPS", "sharpness"].map(|metric| format!("B - A, {metric} (95 %)"));
        let header = ["method", "scenes", "PSNR of A", &metrics[0], &metrics[1], &metrics[2], &metrics[3]];
        writeln!(f, "{}", table(header, self.pairs.iter().map(cells)))?;
        writeln!(
            f,
            "\nMeans of paired differences over scenes, with 95 % intervals of Student's t; *: the interval excludes zero. Lower \
             LPIPS is better."
        )?;
        let largest = |count: fn(&PairedRow) -> usize| self.pairs.iter().map(count).max().unwrap_or_default();
        let (only_a, only_b) = (largest(|pair| pair.num_only_a), largest(|pair| pair.num_only_b));
        if only_a + only_b > 0 {
            let common = self.pairs.iter().map(|pair| pair.num_views).max().unwrap_or_default();
            writeln!(
                f,
                "The evaluations have different target views: {common} common views are compared, up to {only_a} views of A \
                 and {only_b} views of B are ignored."
            )?;
        }
        for (side, keys) in [("A", &self.only_a), ("B", &self.only_b)] {
            if !keys.is_empty() {
                let keys = keys.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
                writeln!(f, "Only in {side}, not compared: {keys}.")?;
            }
        }
        Ok(())
    }
}

fn cells(pair: &PairedRow) -> [String; 7] {
    [
        pair.key.to_string(),
        pair.num_scenes.to_string(),
        pair.psnr.map_or_else(|| "-".into(), |difference| format!("{:.2}", difference.a)),
        interval(pair.psnr, 3),
        interval(pair.ssim, 4),
        interval(pair.lpips_vgg, 4),
        interval(pair.sharpness, 3),
    ]
}

fn interval(difference: Option<MetricDifference>, decimals: usize) -> String {
    let Some(difference) = difference else { return "-".into() };
    let mark = if difference.is_clear() { " *" } else { "" };
    match difference.interval {
        Some([low, high]) => {
            format!("{:+.decimals$} [{low:+.decimals$}, {high:+.decimals$}]{mark}", difference.mean)
        }
        None => format!("{:+.decimals$}", difference.mean),
    }
}

#[cfg(test)]
mod tests;
