//! Statistics of an evaluation index: usable keys, views per scene, targets that are also contexts.

use std::fmt;

use serde::Serialize;

use crate::sampling::clip::ViewIndices;
use crate::sampling::evaluation_index::EvaluationIndex;

/// Counts of an [`EvaluationIndex`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct IndexStatistics {
    /// Number of keys, null and empty entries included.
    pub num_keys: usize,
    /// Number of keys with views.
    pub num_usable: usize,
    /// Smallest and largest number of context frames of a usable key.
    pub num_context: [usize; 2],
    /// Smallest and largest number of target frames of a usable key.
    pub num_targets_per_scene: [usize; 2],
    /// Number of target frames of all keys.
    pub num_targets: usize,
    /// Number of targets that are also context frames: the input contains the answer.
    pub num_targets_given: usize,
    /// Number of keys with at least one such target.
    pub num_scenes_with_given: usize,
}

impl IndexStatistics {
    /// Counts the keys and views of `index`.
    pub fn new(index: &EvaluationIndex) -> Self {
        let mut statistics = Self { num_keys: index.num_keys(), ..Self::default() };
        for (_, views) in index.usable() {
            let given = views.num_context_targets();
            statistics.num_usable += 1;
            statistics.num_targets += views.target.len();
            statistics.num_targets_given += given;
            statistics.num_scenes_with_given += usize::from(given > 0);
        }
        let bounds = |count: fn(&ViewIndices) -> usize| {
            let counts = || index.usable().map(|(_, views)| count(views));
            [counts().min().unwrap_or(0), counts().max().unwrap_or(0)]
        };
        statistics.num_context = bounds(|views| views.context.len());
        statistics.num_targets_per_scene = bounds(|views| views.target.len());
        statistics
    }
}

impl fmt::Display for IndexStatistics {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let range =
            |[least, most]: [usize; 2]| if least == most { least.to_string() } else { format!("{least} to {most}") };
        let Self { num_keys, num_usable, num_targets, num_targets_given, .. } = self;
        writeln!(f, "{num_usable} of {num_keys} keys have views, {} have none", num_keys - num_usable)?;
        writeln!(
            f,
            "{} context and {} target frames a scene, {num_targets} targets in all",
            range(self.num_context),
            range(self.num_targets_per_scene)
        )?;
        let share = 100.0 * *num_targets_given as f64 / (*num_targets).max(1) as f64;
        let scenes = self.num_scenes_with_given;
        write!(f, "{num_targets_given} targets ({share:.1} %) of {scenes} scenes are context frames as well")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::read_from_file;

    fn statistics(json: &str) -> IndexStatistics {
        IndexStatistics::new(&read_from_file("index.json", json, EvaluationIndex::read).unwrap())
    }

    #[test]
    fn views_and_shared_targets_are_counted() {
        let found = statistics(
            r#"{"a": {"context": [0, 9], "target": [0, 9, 4]}, "b": {}, "c": {"context": [1, 2, 3], "target": [2]}}"#,
        );
        assert_eq!((found.num_context, found.num_targets_per_scene), ([2, 3], [1, 3]));
        assert_eq!((found.num_targets, found.num_targets_given, found.num_scenes_with_given), (4, 3, 2));
        let text = found.to_string();
        assert!(text.contains("2 of 3 keys have views, 1 have none"), "{text}");
        assert!(text.contains("2 to 3 context and 1 to 3 target frames"), "{text}");
        assert!(text.contains("3 targets (75.0 %) of 2 scenes"), "{text}");
        let none = statistics(r#"{"a": null}"#);
        assert_eq!((none.num_keys, none.num_usable), (1, 0));
        assert!(none.to_string().contains("0 targets (0.0 %)"), "{none}");
    }
}
