//! The results of one scene of a sweep, from which its figures are made.

use clift_model::SceneClusters;

use crate::statistics::view_metrics::EvalKey;
use crate::sweep::rendered_views::ScoredViews;
use crate::sweep::token_choice::SelectedTokens;

/// Largest number of target views whose images are kept.
const MAX_KEPT_VIEWS: usize = 6;

/// Images, clusters and selected tokens of one scene.
pub struct SceneResults {
    /// The renderings of every key: baselines first, external methods last.
    pub(crate) renderings: Vec<ScoredViews>,
    /// The clusters of every storage count.
    pub(crate) clusters: Vec<SceneClusters>,
    /// The patches of the stored tokens, and the tokens selected for every target.
    pub(crate) selections: Vec<(EvalKey, Vec<u32>, Vec<SelectedTokens>)>,
    /// The target views whose images are kept; at least one.
    pub(crate) kept_views: Vec<usize>,
}

impl SceneResults {
    /// Starts with the baselines, of which the images of `kept_views` are kept.
    pub(crate) fn new(baselines: Vec<ScoredViews>, kept_views: Vec<usize>) -> Self {
        Self { renderings: baselines, clusters: Vec::new(), selections: Vec::new(), kept_views }
    }
}

/// Returns the target views whose images are kept: all, or six of them from the first to the last.
pub(crate) fn kept_views(num_views: usize) -> Vec<usize> {
    spread(num_views, MAX_KEPT_VIEWS)
}

/// Returns all of `0..count`, or `most` of them from the first to the last; `most` is at least 2.
pub(crate) fn spread(count: usize, most: usize) -> Vec<usize> {
    if count <= most {
        return (0..count).collect();
    }
    (0..most).map(|i| i * (count - 1) / (most - 1)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kept_views_span_first_to_last() {
        assert_eq!(kept_views(6), [0, 1, 2, 3, 4, 5]);
        assert_eq!(kept_views(121), [0, 24, 48, 72, 96, 120]);
    }
}
