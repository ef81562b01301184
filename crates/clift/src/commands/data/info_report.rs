//! Table and JSON of `clift data info`.

use std::collections::BTreeMap;
use std::fmt;
use std::path::PathBuf;

use clift_data::{SkippedFrame, SkippedScene, SourceInfo, SourceKind, plural};
use serde::Serialize;

/// Most keys, and most image sizes, that the table lists.
const MAX_LISTED_KEYS: usize = 8;
/// Most scenes, and groups of scenes, that the table lists; the JSON lists all.
const MAX_LISTED_SCENES: usize = 20;
/// Most frames of one scene that the table lists.
const MAX_LISTED_FRAMES: usize = 50;

#[derive(Debug, Default, Serialize)]
pub struct Report {
    pub path: PathBuf,
    pub layout: Option<SourceKind>,
    /// Splits by name; `all` for a data set without splits.
    pub splits: BTreeMap<String, SplitReport>,
}

#[derive(Debug, Default, Serialize)]
pub struct SplitReport {
    /// Reason why the split is not usable.
    pub error: Option<String>,
    pub num_scenes: usize,
    /// Number of scenes after the filters.
    pub num_used: usize,
    pub skipped: BTreeMap<String, usize>,
    /// Skipped scenes, each with its reason.
    pub left_out: Vec<SkippedScene>,
    pub frames: Vec<SkippedFrame>,
    pub notes: Vec<String>,
    /// Keys of the used scenes.
    pub keys: Vec<String>,
    /// Sizes and extents of the used scenes.
    pub info: Option<SourceInfo>,
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
                None => rows.push((name, "not found".into())),
                Some(split) => split.rows(name, &mut rows),
            }
        }
        let lines: Vec<String> = rows.iter().map(|(name, value)| format!("{name:<18}{value}")).collect();
        f.write_str(&lines.join("\n"))
    }
}

/// Formats up to `most` names, with `..` for the others.
fn first_names(names: &[&str], most: usize) -> String {
    let more = if names.len() > most { ", .." } else { "" };
    format!("{}{more}", names[..names.len().min(most)].join(", "))
}

/// Lists the image sizes, the most frequent first, with their numbers of scenes if there are several.
fn image_row(sizes: &BTreeMap<String, usize>) -> Option<String> {
    let mut sizes: Vec<(&String, &usize)> = sizes.iter().collect();
    sizes.sort_by_key(|(_, count)| std::cmp::Reverse(**count));
    match sizes[..] {
        [] => None,
        [(size, _)] => Some(size.clone()),
        _ => {
            let listed = sizes.iter().map(|(size, count)| format!("{size} ({})", plural(**count, "scene")));
            let listed: Vec<String> = listed.take(MAX_LISTED_KEYS + 1).collect();
            Some(first_names(&listed.iter().map(String::as_str).collect::<Vec<_>>(), MAX_LISTED_KEYS))
        }
    }
}

/// Appends the skipped scenes by reason, then the skipped frames by scene and reason.
fn skipped_rows(scenes: &[SkippedScene], frames: &[SkippedFrame], rows: &mut Vec<(&str, String)>) {
    let mut keys: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for SkippedScene { key, reason } in scenes {
        keys.entry(reason).or_default().push(key);
    }
    let scenes = keys.iter().map(|(reason, keys)| match keys[..] {
        [key] => format!("{key}: {reason}"),
        _ => format!("{} {reason}: {}", keys.len(), first_names(keys, MAX_LISTED_SCENES)),
    });
    let mut names: BTreeMap<(&str, &str), Vec<&str>> = BTreeMap::new();
    for SkippedFrame { key, frame, reason } in frames {
        names.entry((key, reason)).or_default().push(frame);
    }
    let frames = names.iter().map(|((key, reason), names)| {
        format!("of {key} {} {reason}: {}", plural(names.len(), "frame"), first_names(names, MAX_LISTED_FRAMES))
    });
    for (mut groups, more) in
        [(scenes.collect::<Vec<_>>(), "scenes for {} more reasons"), (frames.collect(), "frames of {} more scenes")]
    {
        let num_more = groups.len().saturating_sub(MAX_LISTED_SCENES);
        groups.truncate(MAX_LISTED_SCENES);
        groups.extend((num_more > 0).then(|| more.replace("{}", &num_more.to_string())));
        rows.extend(groups.into_iter().map(|group| ("  skipped", group)));
    }
}

impl SplitReport {
    fn rows<'a>(&self, name: &'a str, rows: &mut Vec<(&'a str, String)>) {
        if let Some(error) = &self.error {
            rows.push((name, error.clone()));
            return;
        }
        let used = if self.skipped.is_empty() { String::new() } else { format!("{} of ", self.num_used) };
        rows.push((name, format!("{used}{}", plural(self.num_scenes, "scene"))));
        let keys: Vec<&str> = self.keys.iter().map(String::as_str).take(MAX_LISTED_KEYS + 1).collect();
        if !keys.is_empty() {
            rows.push(("  keys", first_names(&keys, MAX_LISTED_KEYS)));
        }
        skipped_rows(&self.left_out, &self.frames, rows);
        rows.extend(self.notes.iter().map(|note| ("  note", note.clone())));
        let Some(info) = &self.info else { return };
        for SkippedScene { key, reason } in info.unreadable.iter().take(MAX_LISTED_SCENES) {
            rows.push(("  unreadable", format!("{key}: {reason}")));
        }
        if info.unreadable.len() > MAX_LISTED_SCENES {
            rows.push(("  unreadable", format!("{} more scenes", info.unreadable.len() - MAX_LISTED_SCENES)));
        }
        if let Some(frames) = info.num_frames {
            rows.push(("  frames", format!("{frames} (smallest / median / largest)")));
        }
        rows.extend(image_row(&info.image_sizes).map(|sizes| ("  image", sizes)));
        if let Some(fov) = info.fov_deg {
            rows.push(("  field of view", format!("{fov:.1} deg")));
        }
        if let Some(extent) = info.extent {
            rows.push(("  path extent", format!("{extent:.3}")));
        }
    }
}
