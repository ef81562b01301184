//! Lists of test scenes, such as the 140 benchmark scenes of DL3DV, whose folders lie beside the training scenes.

use std::collections::{BTreeSet, HashMap};
use std::path::Path;

use serde::de::IgnoredAny;

use crate::error::DataError;
use crate::files::bounded::read_bounded;
use crate::scene_source::Split;
use crate::skip_report::SkipReport;
use crate::sources::keys::{last_name, plain_key};

/// Largest size of a list, in bytes.
const MAX_BYTES: u64 = 256 << 20;
/// Reason of skipping a test scene in the training split; no fault of the scene.
pub(crate) const KEPT_FOR_TESTING: &str = "kept for testing";

/// Keys of the test scenes, without the prefix of DepthSplat; for DL3DV scenes, without their path.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TestScenes {
    keys: BTreeSet<String>,
}

impl TestScenes {
    /// Reads the keys of an evaluation index, a JSON list of keys, or a text file with one key per line.
    ///
    /// # Errors
    /// [`DataError::Io`], and [`DataError::BadIndex`] for another format.
    pub fn read(path: &Path) -> Result<Self, DataError> {
        let bad = |what: String| DataError::BadIndex { what, path: path.to_owned() };
        let bytes = read_bounded(path, MAX_BYTES, "reading the list of test scenes")?;
        let text = String::from_utf8(bytes).map_err(|_| bad("the list of test scenes is not UTF-8".into()))?;
        let text = text.trim_start_matches('\u{feff}');
        let json = |error: serde_json::Error| bad(format!("expected an index, a list or a key per line, got {error}"));
        let keys: Vec<String> = match text.trim_start().chars().next() {
            Some('{') => {
                let index: HashMap<String, Option<IgnoredAny>> = serde_json::from_str(text).map_err(json)?;
                index.into_keys().collect()
            }
            Some('[') => serde_json::from_str(text).map_err(json)?,
            _ => text.lines().map(|line| line.trim().to_owned()).filter(|line| !line.is_empty()).collect(),
        };
        Ok(Self { keys: keys.iter().map(|key| plain_key(key).to_owned()).collect() })
    }

    /// Returns whether the list contains a scene, by its key with or without the prefix of DepthSplat, or by the last part
    /// of a key that is a path.
    pub fn contains(&self, key: &str) -> bool {
        self.keys.contains(plain_key(key)) || self.keys.contains(last_name(key))
    }

    /// Returns the number of listed scenes.
    pub fn num_scenes(&self) -> usize {
        self.keys.len()
    }

    /// Returns which of `keys` belong to a split, and a report of the skipped scenes: listed scenes in the training split,
    /// and in a test split that shares its folder, listed scenes without files.
    pub(crate) fn divide(&self, keys: &[String], split: Split, is_shared: bool) -> (Vec<bool>, SkipReport) {
        let mut report = SkipReport::default();
        let kept: Vec<bool> = keys
            .iter()
            .map(|key| match split {
                Split::Train => !self.contains(key),
                Split::Test => !is_shared || self.contains(key),
            })
            .collect();
        if split == Split::Train {
            keys.iter().zip(&kept).filter(|(_, kept)| !**kept).for_each(|(key, _)| report.skip(key, KEPT_FOR_TESTING));
        } else if is_shared {
            let present: BTreeSet<&str> = keys.iter().flat_map(|key| [plain_key(key), last_name(key)]).collect();
            let absent = self.keys.iter().filter(|key| !present.contains(key.as_str()));
            absent.for_each(|key| report.skip(key, "in the list of test scenes, but not there"));
        }
        report.num_scenes = report.skips.len();
        (kept, report)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::read_from_file;

    fn read(text: &str) -> Result<TestScenes, String> {
        read_from_file("list", text, TestScenes::read).map_err(|error| error.to_string())
    }

    #[test]
    fn all_formats_give_the_same_scenes() {
        let index = read(r#"{"a": {"context": [0], "target": [1]}, "dl3dv_b": null}"#).unwrap();
        assert_eq!(index, read(r#" ["b", "a"]"#).unwrap());
        assert_eq!(index, read("a\r\n\n  b\n").unwrap());
        assert!(index.contains("dl3dv_a") && index.contains("b") && !index.contains("c"));
        assert_eq!((index.num_scenes(), read("").unwrap().num_scenes()), (2, 0));
        assert!(read("[1, 2]").unwrap_err().contains("expected an index, a list or a key per line, got"));
        assert!(read("{\"a\": ").unwrap_err().starts_with("bad index: "));
    }

    #[test]
    fn copies_of_test_scenes_are_kept_out_of_training() {
        let hash = "a".repeat(64);
        let keys = [format!("1K/{hash}"), format!("bench/{hash}"), "1K/attic".into(), "bench/attic".into()];
        for (listed, kept) in [
            (hash.clone(), [false, false, true, true]),
            (format!("11K/{hash}"), [false, false, true, true]),
            (format!("dl3dv_{hash}"), [false, false, true, true]),
            // Captures of one name differ by their path; the name alone matches both.
            ("1K/attic".into(), [true, true, false, true]),
            ("attic".into(), [true, true, false, false]),
        ] {
            assert_eq!(read(&listed).unwrap().divide(&keys, Split::Train, true).0, kept, "{listed}");
        }
    }

    #[test]
    fn training_and_test_scenes_are_disjoint() {
        let list = read("\u{feff}b\nc c").unwrap();
        assert!(list.contains("c c"), "a line is a key");
        let keys = ["a", "dl3dv_b", "d"].map(String::from);
        for (split, is_shared, kept, expected) in [
            (Split::Train, true, [true, false, true], "0 of 1 scene used; 1 kept for testing"),
            (Split::Train, false, [true, false, true], "0 of 1 scene used; 1 kept for testing"),
            (Split::Test, true, [false, true, false], "0 of 1 scene used; 1 in the list of test scenes, but not there"),
            (Split::Test, false, [true; 3], "0 scenes used"),
        ] {
            let (got, report) = list.divide(&keys, split, is_shared);
            assert_eq!((got, report.to_string()), (kept.to_vec(), expected.to_owned()));
        }
    }
}
