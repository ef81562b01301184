//! Skipped scenes and frames with their reasons.

use std::collections::BTreeMap;
use std::fmt;

use clift_core::{first_few, plural};
use serde::{Deserialize, Serialize};

/// Number of reasons in a printed report.
const MAX_REASONS_SHOWN: usize = 8;

/// A skipped scene.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SkippedScene {
    /// Scene key.
    pub key: String,
    /// Reason, with the same text for equal cases so that they can be counted.
    pub reason: String,
}

/// A skipped frame.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SkippedFrame {
    /// Scene key.
    pub key: String,
    /// Name of the frame in the camera file: an image name or a time stamp.
    pub frame: String,
    /// Reason, with the same text for equal cases.
    pub reason: String,
}

/// Number of examined scenes, and the scenes and frames that were skipped. Prints as
/// `2 of 3 scenes used; 1 shorter than 46 frames`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SkipReport {
    /// Number of examined scenes, used and skipped.
    pub num_scenes: usize,
    /// Skipped scenes, in the order of examination.
    pub skips: Vec<SkippedScene>,
    /// Skipped frames, of used scenes and of scenes that were skipped because of these frames.
    pub frames: Vec<SkippedFrame>,
    /// Further notes on the scenes, without a full stop.
    pub notes: Vec<String>,
}

impl SkipReport {
    /// Creates a report of `num_scenes` scenes without skipped ones.
    pub fn new(num_scenes: usize) -> Self {
        Self { num_scenes, ..Self::default() }
    }

    /// Adds a skipped scene.
    pub fn skip(&mut self, key: impl Into<String>, reason: impl Into<String>) {
        self.skips.push(SkippedScene { key: key.into(), reason: reason.into() });
    }

    /// Adds a skipped frame.
    pub fn skip_frame(&mut self, key: impl Into<String>, frame: impl Into<String>, reason: impl Into<String>) {
        self.frames.push(SkippedFrame { key: key.into(), frame: frame.into(), reason: reason.into() });
    }

    /// Returns whether a scene or a frame was skipped.
    pub fn has_skips(&self) -> bool {
        !(self.skips.is_empty() && self.frames.is_empty())
    }

    /// Returns whether the report has a skipped scene, a skipped frame or a note.
    pub fn has_content(&self) -> bool {
        self.has_skips() || !self.notes.is_empty()
    }

    /// Returns the number of used scenes.
    pub fn num_used(&self) -> usize {
        self.num_scenes.saturating_sub(self.skips.len())
    }

    /// Returns the number of skipped scenes per reason.
    pub fn counts(&self) -> BTreeMap<&str, usize> {
        let mut counts = BTreeMap::new();
        for skip in &self.skips {
            *counts.entry(skip.reason.as_str()).or_insert(0) += 1;
        }
        counts
    }

    /// Returns the names of the skipped frames per reason.
    pub fn frame_names(&self) -> BTreeMap<&str, Vec<&str>> {
        let mut names: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
        for skip in &self.frames {
            names.entry(&skip.reason).or_default().push(&skip.frame);
        }
        names
    }

    pub(crate) fn append(&mut self, other: Self) {
        self.num_scenes += other.num_scenes;
        self.skips.extend(other.skips);
        self.frames.extend(other.frames);
        self.notes.extend(other.notes);
    }
}

impl fmt::Display for SkipReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let all = plural(self.num_scenes, "scene");
        match (self.num_used(), self.num_scenes) {
            (used, num_scenes) if used < num_scenes => write!(f, "{used} of {all} used")?,
            (_, 0 | 1) => write!(f, "{all} used")?,
            _ => write!(f, "all {all} used")?,
        }
        let counts = self.counts();
        for (reason, count) in counts.iter().take(MAX_REASONS_SHOWN) {
            write!(f, "; {count} {reason}")?;
        }
        if counts.len() > MAX_REASONS_SHOWN {
            write!(f, "; {} for other reasons", counts.values().skip(MAX_REASONS_SHOWN).sum::<usize>())?;
        }
        for (reason, names) in self.frame_names() {
            write!(f, "; {} {reason} ({})", plural(names.len(), "frame"), first_few(&names))?;
        }
        self.notes.iter().try_for_each(|note| write!(f, "; {note}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reports_print_used_scenes_reasons_skipped_frames_and_notes() {
        let mut report = SkipReport::new(5);
        assert!(!report.has_content() && report.to_string() == "all 5 scenes used");
        report.notes.push("both splits hold all scenes".into());
        assert!(report.has_content() && !report.has_skips());
        report.skip("a", "shorter than 46 frames");
        report.skip("b", "null in the evaluation index");
        report.skip("c", "shorter than 46 frames");
        for frame in ["1.jpg", "5.jpg", "6.jpg", "7.jpg"] {
            report.skip_frame("fox", frame, "without an image");
        }
        report.skip_frame("fox", "9.jpg", "named twice");
        let expected = "2 of 5 scenes used; 1 null in the evaluation index; 2 shorter than 46 frames; \
            1 frame named twice (9.jpg); 4 frames without an image (1.jpg, 5.jpg, 6.jpg, ..); both splits hold all scenes";
        assert_eq!(report.to_string(), expected);
        (0..8).for_each(|number| report.skip("d", format!("broken {number}")));
        assert!(report.to_string().contains("; 1 broken 7; 3 for other reasons; 1 frame"), "{report}");
    }
}
