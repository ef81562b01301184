//! What `clift data info` tells, as a table and as JSON.

use std::collections::BTreeMap;
use std::fmt;
use std::path::PathBuf;

use clift_data::{SkippedFrame, SkippedScene, SourceInfo, SourceKind};
use serde::Serialize;

use crate::commands::data::text::count;

/// Scenes whose frames are named; JSON has all.
const MAX_SCENES_NAMED: usize = 20;
/// Frames that are named of one scene.
const MAX_FRAMES_NAMED: usize = 50;

/// What is told about a folder or a config.
#[derive(Debug, Default, Serialize)]
pub struct Report {
    /// What was looked at.
    pub path: PathBuf,
    /// How the scenes lie on disk; for a folder.
    pub layout: Option<SourceKind>,
    /// By name; `all` for a folder without `train/` and `test/`.
    pub splits: BTreeMap<String, SplitReport>,
    /// Scenes that are evaluated, or why there are none; for a config.
    pub evaluation: Option<EvaluationReport>,
    /// Tokens of a scene with the fewest and the most contexts; for a config.
    pub num_tokens: Option<[usize; 2]>,
}

/// One half of a data set.
#[derive(Debug, Default, Serialize)]
pub struct SplitReport {
    /// Why the split cannot be used.
    pub error: Option<String>,
    /// Scenes there are.
    pub num_scenes: usize,
    /// Scenes the filters leave.
    pub num_used: usize,
    /// Scenes the filters leave out, by reason.
    pub skipped: BTreeMap<String, usize>,
    /// The same scenes one by one, each with its reason.
    pub left_out: Vec<SkippedScene>,
    /// Frames left out of scenes.
    pub frames: Vec<SkippedFrame>,
    /// What else is to be known.
    pub notes: Vec<String>,
    /// Scenes that `info` describes: the first of many synthetic ones, otherwise all that are used.
    pub num_described: usize,
    /// Their description.
    pub info: Option<SourceInfo>,
    /// Frames that `data.views` needs, and how many of the described scenes have them; for training scenes.
    pub views: Option<[usize; 2]>,
}

/// What an evaluation takes.
#[derive(Debug, Default, Serialize)]
pub struct EvaluationReport {
    /// Why nothing can be evaluated.
    pub error: Option<String>,
    /// Scenes.
    pub num_scenes: usize,
    /// Target views of all scenes.
    pub num_views: usize,
    /// Scenes left out, by reason.
    pub skipped: BTreeMap<String, usize>,
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut rows: Vec<(&str, String)> = Vec::new();
        if let Some(layout) = self.layout {
            rows.push(("layout", layout.to_string()));
        }
        let names = if self.splits.contains_key("all") { &["all"][..] } else { &["train", "test"] };
        for name in names {
            match self.splits.get(*name) {
                None => rows.push((name, "not there".into())),
                Some(split) => split.rows(name, &mut rows),
            }
        }
        if let Some(evaluation) = &self.evaluation {
            let counted =
                format!("{} of {}", count(evaluation.num_views, "view"), count(evaluation.num_scenes, "scene"));
            rows.push(("evaluation", evaluation.error.clone().unwrap_or(counted)));
            left_out(&evaluation.skipped, &mut rows);
        }
        match self.num_tokens {
            Some([fewest, most]) if fewest == most => rows.push(("tokens per scene", fewest.to_string())),
            Some([fewest, most]) => rows.push(("tokens per scene", format!("{fewest} to {most}"))),
            None => {}
        }
        let lines: Vec<String> = rows.iter().map(|(name, value)| format!("{name:<18}{value}")).collect();
        f.write_str(&lines.join("\n"))
    }
}

fn left_out(skipped: &BTreeMap<String, usize>, rows: &mut Vec<(&str, String)>) {
    rows.extend(skipped.iter().map(|(reason, count)| ("  left out", format!("{count} {reason}"))));
}

/// Names the scenes that are left out, reason by reason.
fn scenes_left_out(skips: &[SkippedScene], rows: &mut Vec<(&str, String)>) {
    let mut keys: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for SkippedScene { key, reason } in skips {
        keys.entry(reason).or_default().push(key);
    }
    let num_reasons = keys.len();
    for (reason, keys) in keys.into_iter().take(MAX_SCENES_NAMED) {
        let more = if keys.len() > MAX_SCENES_NAMED { ", .." } else { "" };
        let shown = keys[..keys.len().min(MAX_SCENES_NAMED)].join(", ");
        rows.push(match keys.len() {
            1 => ("  left out", format!("{shown}: {reason}")),
            number => ("  left out", format!("{number} {reason}: {shown}{more}")),
        });
    }
    if num_reasons > MAX_SCENES_NAMED {
        rows.push(("  left out", format!("scenes for {} more reasons", num_reasons - MAX_SCENES_NAMED)));
    }
}

/// Names the frames that are left out, scene by scene and reason by reason.
fn frames_left_out(frames: &[SkippedFrame], rows: &mut Vec<(&str, String)>) {
    let mut names: BTreeMap<(&str, &str), Vec<&str>> = BTreeMap::new();
    for SkippedFrame { key, frame, reason } in frames {
        names.entry((key, reason)).or_default().push(frame);
    }
    let num_groups = names.len();
    for ((key, reason), names) in names.into_iter().take(MAX_SCENES_NAMED) {
        let more = if names.len() > MAX_FRAMES_NAMED { ", .." } else { "" };
        let shown = names[..names.len().min(MAX_FRAMES_NAMED)].join(", ");
        rows.push(("  left out", format!("of {key} {} {reason}: {shown}{more}", count(names.len(), "frame"))));
    }
    if num_groups > MAX_SCENES_NAMED {
        rows.push(("  left out", format!("frames of {} more scenes", num_groups - MAX_SCENES_NAMED)));
    }
}

impl SplitReport {
    fn rows<'a>(&self, name: &'a str, rows: &mut Vec<(&'a str, String)>) {
        if let Some(error) = &self.error {
            rows.push((name, error.clone()));
            return;
        }
        let used = if self.skipped.is_empty() { String::new() } else { format!("{} of ", self.num_used) };
        let first = format!("; described by the first {}", self.num_described);
        let first = if self.num_described < self.num_used { first.as_str() } else { "" };
        rows.push((name, format!("{used}{}{first}", count(self.num_scenes, "scene"))));
        scenes_left_out(&self.left_out, rows);
        frames_left_out(&self.frames, rows);
        rows.extend(self.notes.iter().map(|note| ("  note", note.clone())));
        let Some(info) = &self.info else { return };
        for SkippedScene { key, reason } in info.unreadable.iter().take(MAX_SCENES_NAMED) {
            rows.push(("  unreadable", format!("{key}: {reason}")));
        }
        if info.unreadable.len() > MAX_SCENES_NAMED {
            rows.push(("  unreadable", format!("{} more scenes", info.unreadable.len() - MAX_SCENES_NAMED)));
        }
        if let Some(frames) = info.num_frames {
            rows.push(("  frames", format!("{frames} (smallest / median / largest)")));
        }
        if let Some([width, height]) = info.image_size {
            rows.push(("  picture", format!("{width}x{height}")));
        }
        if let Some(fov) = info.fov_deg {
            rows.push(("  field of view", format!("{fov:.1} deg")));
        }
        if let Some(extent) = info.extent {
            rows.push(("  path extent", format!("{extent:.3}")));
        }
        if let Some([needed, num_long]) = self.views {
            let of = self.num_described;
            rows.push(("  long enough", format!("{num_long} of {of}: data.views needs {}", count(needed, "frame"))));
        }
    }
}
