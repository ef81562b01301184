//! Which variant is better, scene by scene.
//!
//! Scenes differ far more than variants do: the standard error of a difference is that of the differences of the same
//! scenes, not that of two means.

use std::collections::BTreeMap;

use clift_data::{mean, standard_error};
use clift_model::TokenFormat;
use serde::{Deserialize, Serialize};

use crate::config::method::Method;
use crate::statistics::eval_results::{EvalResults, SceneViews};
use crate::statistics::scene_means::capped;
use crate::statistics::view_metrics::{EvalKey, ViewMetrics};

/// What the paper says is better than what (section 4.3): the better one first.
const ORDERINGS: [[Method; 2]; 5] = [
    [Method::Kmeans, Method::Random],
    [Method::Clift, Method::Kmeans],
    [Method::Kmeans, Method::Patch],
    [Method::PatchClift, Method::Patch],
    [Method::Clift, Method::PatchClift],
];

/// Mean difference of the PSNR of the same scenes in two variants, all stored tokens rendered.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PairedDifference {
    /// The variant that the paper finds better.
    pub variant: Method,
    /// The one it is compared with.
    pub against: Method,
    /// Tokens in the scene file, of both.
    pub num_storage_tokens: usize,
    /// Number format of the stored tokens, of both; random subsets are never rounded.
    pub tokens: Option<TokenFormat>,
    /// Scenes that were measured in both.
    pub num_scenes: usize,
    /// Mean over those scenes of `variant` less `against`, in dB: positive where the paper's order holds.
    pub psnr: f64,
    /// Standard error of that mean; `null` for a single scene.
    pub psnr_stderr: Option<f64>,
}

/// Compares both variants of every ordering at equal counts, by ordering and rising token count.
pub fn differences(results: &EvalResults) -> Vec<PairedDifference> {
    let mut differences = Vec::new();
    for [variant, against] in ORDERINGS {
        for (key, better) in results.views().filter(|(key, _)| key.variant == variant && key.is_whole()) {
            let tokens = if against == Method::Random { Some(TokenFormat::F32) } else { key.tokens };
            let Some(other) = results.of(EvalKey { variant: against, tokens, ..key }) else { continue };
            let per_scene = scene_differences(better, other);
            differences.extend(mean(&per_scene).map(|psnr| PairedDifference {
                variant,
                against,
                num_storage_tokens: key.num_storage_tokens,
                tokens: key.tokens,
                num_scenes: per_scene.len(),
                psnr,
                psnr_stderr: standard_error(&per_scene),
            }));
        }
    }
    differences
}

/// Returns the mean PSNR difference of every scene, over the views of both sides.
fn scene_differences(better: &SceneViews, other: &SceneViews) -> Vec<f64> {
    let of_scene = |(scene, views): (&String, &BTreeMap<usize, ViewMetrics>)| {
        let others = other.get(scene)?;
        let pairs = views.iter().filter_map(|(frame, view)| Some((view, others.get(frame)?)));
        mean(&pairs.map(|(view, against)| capped(view.psnr) - capped(against.psnr)).collect::<Vec<_>>())
    };
    better.iter().filter_map(of_scene).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn key(variant: Method, num_storage_tokens: usize, num_render_tokens: usize) -> EvalKey {
        EvalKey { variant, num_storage_tokens, num_render_tokens, tokens: Some(TokenFormat::F32) }
    }

    fn differences_of(rows: &[(&str, usize, EvalKey, f64)]) -> Vec<PairedDifference> {
        let mut results = EvalResults::default();
        for &(scene, frame, key, psnr) in rows {
            results.add(scene, frame, key, ViewMetrics::quality(psnr, None)).unwrap();
        }
        differences(&results)
    }

    #[test]
    fn scenes_are_paired_and_views_averaged_within_them() {
        let (better, worse) = (key(Method::Kmeans, 8, 8), key(Method::Random, 8, 8));
        let differences = differences_of(&[
            ("attic", 1, better, 21.0),
            ("attic", 2, better, 24.0),
            ("attic", 1, worse, 20.0),
            ("attic", 2, worse, 21.0),
            ("cellar", 1, better, 10.0),
            ("cellar", 1, worse, 11.0),
            // ViewMetrics on one side alone.
            ("hall", 1, better, 30.0),
        ]);
        let [difference] = &differences[..] else { panic!("one ordering at one count") };
        // 2 dB in the attic, -1 dB in the cellar.
        assert_eq!((difference.variant, difference.against), (Method::Kmeans, Method::Random));
        assert_eq!((difference.num_scenes, difference.psnr, difference.psnr_stderr), (2, 0.5, Some(1.5)));
    }

    #[test]
    fn counts_are_compared_with_the_same_count_and_only_where_all_tokens_are_rendered() {
        let differences = differences_of(&[
            ("attic", 1, key(Method::Clift, 8, 8), 20.0),
            ("attic", 1, key(Method::Clift, 8, 4), 19.0),
            ("attic", 1, key(Method::Kmeans, 8, 4), 18.0),
            ("attic", 1, key(Method::Kmeans, 16, 16), 22.0),
            ("attic", 1, key(Method::Clift, 16, 16), f64::INFINITY),
        ]);
        let [difference] = &differences[..] else { panic!("one ordering at one count") };
        assert_eq!((difference.num_storage_tokens, difference.psnr), (16, 100.0 - 22.0));
        assert_eq!(difference.psnr_stderr, None, "of a single scene");
    }
}
