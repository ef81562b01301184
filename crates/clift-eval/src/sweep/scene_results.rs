//! The results of one scene of a sweep, from which its figures are made.

use clift_model::SceneClusters;

use crate::statistics::view_metrics::EvalKey;
use crate::sweep::predictions::ScoredPredictions;
use crate::sweep::rendered_views::ScoredViews;
use crate::sweep::token_choice::SelectedTokens;

/// Largest number of views whose images are kept; more targets are thinned evenly.
const MAX_ROWS: usize = 6;

/// Images, clusters and selected tokens of one scene.
pub struct SceneResults {
    /// The renderings of every key, baselines first.
    pub(crate) renderings: Vec<ScoredViews>,
    /// The clusters of every storage count.
    pub(crate) clusters: Vec<SceneClusters>,
    /// The patches of the stored tokens, and the tokens selected for every target.
    pub(crate) choices: Vec<(EvalKey, Vec<u32>, Vec<SelectedTokens>)>,
    /// The images of other systems.
    pub(crate) others: Vec<ScoredPredictions>,
    /// The views whose images are kept; at least one.
    pub(crate) rows: Vec<usize>,
}

impl SceneResults {
    /// Starts with the baselines, of which the images of `rows` are kept.
    pub(crate) fn new(baselines: Vec<ScoredViews>, rows: Vec<usize>) -> Self {
        Self { renderings: baselines, clusters: Vec::new(), choices: Vec::new(), others: Vec::new(), rows }
    }
}

/// Returns the views whose images are kept: all, or six of them from the first to the last.
pub(crate) fn sheet_rows(num_views: usize) -> Vec<usize> {
    spread(num_views, MAX_ROWS)
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
    fn a_sheet_of_many_views_goes_from_the_first_to_the_last() {
        assert_eq!(sheet_rows(3), [0, 1, 2]);
        assert_eq!(sheet_rows(6), [0, 1, 2, 3, 4, 5]);
        let rows = sheet_rows(121);
        assert_eq!((rows.len(), rows[0], rows[MAX_ROWS - 1]), (MAX_ROWS, 0, 120));
    }
}
