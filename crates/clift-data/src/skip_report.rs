//! The ledger of what was left out: every skipped scene and frame with its reason, counted and printable.

use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};

/// Names of frames that a printed ledger shows per reason; its file has all of them.
const MAX_NAMES_SHOWN: usize = 3;

/// Reasons that a printed ledger shows.
const MAX_REASONS_SHOWN: usize = 8;

/// One scene that was left out.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SkippedScene {
    /// Key of the scene.
    pub key: String,
    /// Why, in words that equal cases share, so that they can be counted.
    pub reason: String,
}

/// One frame that was left out.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SkippedFrame {
    /// Key of its scene.
    pub key: String,
    /// What its file calls it: the name of a picture, or a time stamp.
    pub frame: String,
    /// Why, in words that equal cases share.
    pub reason: String,
}

/// How many scenes there were and what was left out. Prints as `2 of 3 scenes used; 1 shorter than 46 frames`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SkipReport {
    /// Scenes looked at, used or not.
    pub num_scenes: usize,
    /// Scenes left out, in the order they were met.
    pub skips: Vec<SkippedScene>,
    /// Frames left out of scenes: those that are used without them, and those that are left out because of them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub frames: Vec<SkippedFrame>,
    /// What else is to be known about the scenes, in whole sentences without a stop.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub notes: Vec<String>,
}

impl SkipReport {
    /// A ledger of `num_scenes` scenes of which none is left out yet.
    pub fn new(num_scenes: usize) -> Self {
        Self { num_scenes, ..Self::default() }
    }

    /// Notes that a scene is left out.
    pub fn skip(&mut self, key: impl Into<String>, reason: impl Into<String>) {
        self.skips.push(SkippedScene { key: key.into(), reason: reason.into() });
    }

    /// Notes that a frame is left out.
    pub fn skip_frame(&mut self, key: impl Into<String>, frame: impl Into<String>, reason: impl Into<String>) {
        self.frames.push(SkippedFrame { key: key.into(), frame: frame.into(), reason: reason.into() });
    }

    /// Whether anything was left out.
    pub fn has_gaps(&self) -> bool {
        !(self.skips.is_empty() && self.frames.is_empty())
    }

    /// Whether there is anything to tell: something left out, or a note.
    pub fn has_news(&self) -> bool {
        self.has_gaps() || !self.notes.is_empty()
    }

    /// Scenes that are used.
    pub fn num_used(&self) -> usize {
        self.num_scenes.saturating_sub(self.skips.len())
    }

    /// How many scenes each reason left out, by reason.
    pub fn counts(&self) -> BTreeMap<&str, usize> {
        let mut counts = BTreeMap::new();
        for skip in &self.skips {
            *counts.entry(skip.reason.as_str()).or_insert(0) += 1;
        }
        counts
    }

    /// Names of the frames that each reason left out, by reason.
    pub fn frame_names(&self) -> BTreeMap<&str, Vec<&str>> {
        let mut names: BTreeMap<_, Vec<_>> = BTreeMap::new();
        for skip in &self.frames {
            names.entry(skip.reason.as_str()).or_default().push(skip.frame.as_str());
        }
        names
    }
}

impl fmt::Display for SkipReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} of {} scenes used", self.num_used(), self.num_scenes)?;
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

/// The first few names, and dots for the others.
pub(crate) fn first_few<S: AsRef<str>>(names: &[S]) -> String {
    let mut shown: Vec<&str> = names.iter().take(MAX_NAMES_SHOWN).map(AsRef::as_ref).collect();
    if names.len() > shown.len() {
        shown.push("..");
    }
    shown.join(", ")
}

/// A count with its noun: `1 scene`, `2 scenes`.
pub(crate) fn plural(count: usize, noun: &str) -> String {
    format!("{count} {noun}{}", if count == 1 { "" } else { "s" })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ledger_prints_used_and_total_and_counts_each_reason() {
        let mut ledger = SkipReport::new(5);
        assert_eq!(ledger.to_string(), "5 of 5 scenes used");
        ledger.skip("a", "shorter than 46 frames");
        ledger.skip("b", "null in the evaluation index");
        ledger.skip("c", "shorter than 46 frames");
        assert_eq!(ledger.to_string(), "2 of 5 scenes used; 1 null in the evaluation index; 2 shorter than 46 frames");
        (0..8).for_each(|number| ledger.skip("d", format!("broken {number}")));
        assert!(ledger.to_string().ends_with("; 1 broken 7; 3 for other reasons"), "{ledger}");
    }

    #[test]
    fn frames_left_out_are_named_and_counted_and_notes_follow() {
        let mut ledger = SkipReport::new(1);
        assert!(!ledger.has_gaps());
        for frame in ["1.jpg", "5.jpg", "6.jpg", "7.jpg"] {
            ledger.skip_frame("fox", frame, "without a picture");
        }
        ledger.skip_frame("fox", "9.jpg", "named twice");
        ledger.notes.push("both splits hold all scenes".into());
        let expected = "1 of 1 scenes used; 1 frame named twice (9.jpg); \
            4 frames without a picture (1.jpg, 5.jpg, 6.jpg, ..); both splits hold all scenes";
        assert_eq!(ledger.to_string(), expected);
        assert!(ledger.has_gaps());
    }

    #[test]
    fn a_note_alone_is_news_and_no_gap() {
        let mut ledger = SkipReport::new(1);
        assert!(!ledger.has_news());
        ledger.notes.push("only model 0 is used".into());
        assert!(ledger.has_news() && !ledger.has_gaps());
        ledger = SkipReport::new(1);
        ledger.skip("a", "shorter than 46 frames");
        assert!(ledger.has_news());
    }

    #[test]
    fn a_ledger_without_frames_is_written_as_before_and_older_files_are_read() {
        let text = serde_json::to_string(&SkipReport::new(2)).unwrap();
        assert_eq!(text, r#"{"num_scenes":2,"skips":[]}"#);
        assert_eq!(serde_json::from_str::<SkipReport>(&text).unwrap(), SkipReport::new(2));
    }
}
