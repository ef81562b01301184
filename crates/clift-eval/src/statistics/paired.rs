//! Paired differences of the methods of an evaluation.

use clift_scene::TokenCoding;
use serde::{Deserialize, Serialize};

use crate::config::method::Method;
use crate::statistics::eval_results::EvalResults;
use crate::statistics::metric_difference::{MetricDifference, common_views};
use crate::statistics::view_metrics::{EvalKey, PSNR};

/// Pairs of methods, the better method of the paper first (sections 4.2, 4.3); it is compared with other networks too.
const ORDERINGS: [[Method; 2]; 5] = [
    [Method::Kmeans, Method::Random],
    [Method::Clift, Method::Kmeans],
    [Method::Kmeans, Method::Tile],
    [Method::TileClift, Method::Tile],
    [Method::Clift, Method::TileClift],
];

/// Mean PSNR difference of two methods on the same scenes, rendered from all stored tokens; `method` is the one that the paper
/// finds better.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PairedDifference {
    pub method: Method,
    pub against: Method,
    /// Tokens in the scene file, for both methods.
    pub num_storage_tokens: usize,
    /// Number format of the stored tokens of `method`; random subsets are always f32.
    pub tokens: Option<TokenCoding>,
    pub num_scenes: usize,
    /// Mean over scenes of `method` minus `against`, in dB; positive in agreement with the paper.
    pub psnr: f64,
    /// Standard error of `psnr`; `null` for a single scene.
    pub psnr_stderr: Option<f64>,
}

/// Compares the methods of every pair at equal token counts, by pair and ascending count.
pub fn differences(results: &EvalResults) -> Vec<PairedDifference> {
    let mut differences = Vec::new();
    let networks = Method::whole().map(|network| [Method::Clift, network]);
    for [method, against] in ORDERINGS.into_iter().chain(networks) {
        for (key, better) in results.views().filter(|(key, _)| key.method == method && key.is_whole()) {
            let tokens = if against == Method::Random { Some(TokenCoding::F32) } else { key.tokens };
            let Some(other) = results.of(EvalKey { method: against, tokens, ..key }) else { continue };
            let common = common_views(other, better);
            differences.extend(MetricDifference::new(&common, PSNR).map(|psnr| PairedDifference {
                method,
                against,
                num_storage_tokens: key.num_storage_tokens,
                tokens: key.tokens,
                num_scenes: common.len(),
                psnr: psnr.mean,
                psnr_stderr: psnr.stderr,
            }));
        }
    }
    differences
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::statistics::view_metrics::ViewMetrics;
    use crate::testing::f32_key as key;

    #[test]
    fn scenes_are_paired_at_equal_counts() {
        let (better, worse) = (key(Method::Kmeans, 8, 8), key(Method::Random, 8, 8));
        let rows = [
            ("attic", 1, better, 21.0),
            ("attic", 2, better, 24.0),
            ("attic", 1, worse, 20.0),
            ("attic", 2, worse, 21.0),
            ("cellar", 1, better, 10.0),
            ("cellar", 1, worse, 11.0),
            // Without a counterpart.
            ("hall", 1, better, 30.0),
            ("attic", 1, key(Method::Clift, 8, 4), 19.0),
            ("attic", 1, key(Method::Kmeans, 8, 4), 18.0),
            // A single scene.
            ("attic", 1, key(Method::Kmeans, 16, 16), 22.0),
            ("attic", 1, key(Method::Clift, 16, 16), f64::INFINITY),
        ];
        let mut results = EvalResults::default();
        for (scene, frame, key, psnr) in rows {
            results.add(scene, frame, key, ViewMetrics::quality(psnr, None));
        }
        let differences = differences(&results);
        let rows = differences.iter().map(|d| (d.method, d.num_storage_tokens, d.num_scenes, d.psnr, d.psnr_stderr));
        // 2 dB in the attic, -1 dB in the cellar; an infinite PSNR counts as 100 dB.
        let expected = [(Method::Kmeans, 8, 2, 0.5, Some(1.5)), (Method::Clift, 16, 1, 78.0, None)];
        assert_eq!(rows.collect::<Vec<_>>(), expected);
    }
}
