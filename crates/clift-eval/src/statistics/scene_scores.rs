//! The scenes of an evaluation from worst to best.

use std::cmp::Reverse;
use std::collections::BTreeMap;

use crate::config::method::Method;
use crate::statistics::eval_results::EvalResults;
use crate::statistics::view_metrics::{EvalKey, PSNR, ViewMetrics, best_method, view_mean};

/// The mean PSNR of one scene.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneScore {
    /// Key of the scene.
    pub scene: String,
    /// PSNR of the main method, in dB.
    pub psnr: f64,
    /// PSNR of the nearest context view, in dB.
    pub nearest_psnr: Option<f64>,
}

/// The scenes of the main method with most stored tokens, in its finest number format.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SceneScores {
    /// Method and token counts; `None` without an own method.
    pub key: Option<EvalKey>,
    /// Scenes by ascending PSNR.
    pub scenes: Vec<SceneScore>,
}

impl SceneScores {
    /// Averages the views of every scene.
    pub fn new(results: &EvalResults) -> Self {
        let best = best_method(results.views().map(|(key, _)| key));
        let of_best = results.views().filter(|(key, _)| Some(key.method) == best && key.is_whole());
        let most = of_best.max_by_key(|(key, _)| (key.num_storage_tokens, Reverse(key.tokens)));
        let Some((key, views)) = most else { return Self::default() };
        let nearest = results.of(EvalKey::baseline(Method::NearestView));
        let score = |(scene, frames): (&String, &BTreeMap<usize, ViewMetrics>)| {
            let nearest_psnr = nearest.and_then(|views| view_mean(views.get(scene)?, PSNR));
            Some(SceneScore { scene: scene.clone(), psnr: view_mean(frames, PSNR)?, nearest_psnr })
        };
        let mut scenes: Vec<SceneScore> = views.iter().filter_map(score).collect();
        scenes.sort_by(|a, b| a.psnr.total_cmp(&b.psnr));
        Self { key: Some(key), scenes }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::f32_key as key;

    #[test]
    fn scenes_of_the_largest_count_are_sorted_by_psnr() {
        let mut results = EvalResults::default();
        for (scene, frame, key, psnr) in [
            ("attic", 1, key(Method::Clift, 8, 8), 21.0),
            ("attic", 2, key(Method::Clift, 8, 8), 23.0),
            ("hall", 1, key(Method::Clift, 8, 8), 20.0),
            ("hall", 1, key(Method::Clift, 4, 4), 30.0),
            ("hall", 1, key(Method::Random, 16, 16), 40.0),
            ("hall", 1, EvalKey::baseline(Method::NearestView), f64::INFINITY),
        ] {
            results.add(scene, frame, key, ViewMetrics::quality(psnr, None));
        }
        let scores = SceneScores::new(&results);
        assert_eq!(scores.key, Some(key(Method::Clift, 8, 8)));
        let rows = scores.scenes.iter().map(|score| (score.scene.as_str(), score.psnr, score.nearest_psnr));
        assert_eq!(rows.collect::<Vec<_>>(), [("hall", 20.0, Some(100.0)), ("attic", 22.0, None)]);
        assert_eq!(SceneScores::new(&EvalResults::default()), SceneScores::default());
    }
}
