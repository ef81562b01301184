//! What an evaluation index asks for, counted: how much of it can be measured, and how much of that is given.

use std::fmt;

use serde::Serialize;

use crate::sampling::evaluation_index::EvaluationIndex;

/// Counts of an [`EvaluationIndex`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct IndexCensus {
    /// Keys, null and empty entries included.
    pub num_keys: usize,
    /// Keys with views.
    pub num_usable: usize,
    /// Fewest and most context frames of a usable key.
    pub num_context: [usize; 2],
    /// Fewest and most target frames of a usable key.
    pub num_targets_per_scene: [usize; 2],
    /// Target frames of all keys.
    pub num_targets: usize,
    /// Those of them that are context frames too: the answer is among the inputs.
    pub num_targets_given: usize,
    /// Keys with at least one such target.
    pub num_scenes_with_given: usize,
}

impl EvaluationIndex {
    /// Counts what the index asks for.
    pub fn census(&self) -> IndexCensus {
        let mut census = IndexCensus { num_keys: self.num_keys(), ..IndexCensus::default() };
        for (_, views) in self.usable() {
            let given = views.target.iter().filter(|frame| views.context.contains(frame)).count();
            let is_first = census.num_usable == 0;
            census.num_usable += 1;
            census.num_targets += views.target.len();
            census.num_targets_given += given;
            census.num_scenes_with_given += usize::from(given > 0);
            for (bounds, count) in [
                (&mut census.num_context, views.context.len()),
                (&mut census.num_targets_per_scene, views.target.len()),
            ] {
                let [least, most] = *bounds;
                *bounds = if is_first { [count, count] } else { [least.min(count), most.max(count)] };
            }
        }
        census
    }
}

impl fmt::Display for IndexCensus {
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

    fn census(json: &str) -> IndexCensus {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("index.json");
        std::fs::write(&path, json).unwrap();
        EvaluationIndex::read(&path).unwrap().census()
    }

    #[test]
    fn an_index_of_the_published_sizes_gives_the_published_counts() {
        // RealEstate10K's with four contexts: 7,194 keys of which 720 are null, three targets each, 1,243 of them given.
        let entry = |i: usize| match i {
            i if i % 10 == 3 && i < 7200 => format!("\"{i:016x}\": null"),
            i => {
                let inner = if i % 5 == 0 { 20 } else { 21 };
                format!(r#""{i:016x}": {{"context": [0, 10, 20, 45], "target": [5, {inner}, 30], "overlap": 0.7}}"#)
            }
        };
        // 720 keys of 7,200 end in 3; 6 of the others are left off the end, none of them a multiple of 5.
        let entries: Vec<String> =
            (0..7200).filter(|i| ![7191, 7192, 7194, 7196, 7197, 7198].contains(i)).map(entry).collect();
        let text = format!("{{{}}}", entries.join(","));
        let found = census(&text);
        assert_eq!((found.num_keys, found.num_usable, found.num_targets), (7194, 6474, 19_422));
        assert_eq!((found.num_context, found.num_targets_per_scene), ([4, 4], [3, 3]));
        // Every fifth key has frame 20 on both sides.
        assert_eq!((found.num_targets_given, found.num_scenes_with_given), (1440, 1440));
        let given = text.replacen(", 20, 30]", ", 22, 30]", 1440 - 1243);
        let found = census(&given);
        assert_eq!((found.num_targets_given, found.num_usable), (1243, 6474));
        let shown = found.to_string();
        assert!(shown.contains("6474 of 7194 keys have views, 720 have none"), "{shown}");
        assert!(shown.contains("1243 targets (6.4 %) of 1243 scenes"), "{shown}");
    }

    #[test]
    fn scenes_may_differ_and_nothing_usable_is_no_error() {
        let found = census(
            r#"{"a": {"context": [0, 9], "target": [0, 9, 4]}, "b": {}, "c": {"context": [1, 2, 3], "target": [2]}}"#,
        );
        assert_eq!((found.num_context, found.num_targets_per_scene), ([2, 3], [1, 3]));
        assert_eq!((found.num_targets, found.num_targets_given, found.num_scenes_with_given), (4, 3, 2));
        assert!(found.to_string().contains("2 to 3 context and 1 to 3 target frames"), "{found}");
        let none = census(r#"{"a": null}"#);
        assert_eq!((none.num_keys, none.num_usable), (1, 0));
        assert!(none.to_string().contains("0 targets (0.0 %)"), "{none}");
    }
}
