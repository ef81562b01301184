//! `clift data info`.

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

use clift_core::plural;
use clift_data::{DataError, DatasetRoot, OpenedSource, SkipReport, SkippedScene, SourceInfo, SourceKind, open_source};
use serde::Serialize;

use crate::commands::args::shared_args::JsonArg;
use crate::commands::args::splits::{Splits, present_splits, read_all_options};
use crate::output::counter::scan_counter;
use crate::output::stdout::print_result;

/// Most keys, and most image sizes, that the table lists.
const MAX_LISTED_KEYS: usize = 8;
/// Most skipped scenes, and most unreadable ones, that the table lists; the JSON lists all.
const MAX_LISTED_SCENES: usize = 20;

#[derive(Debug, Default, Serialize)]
struct Report {
    path: PathBuf,
    layout: Option<SourceKind>,
    /// Splits by name; `all` for a data set without splits.
    splits: BTreeMap<String, SplitReport>,
}

#[derive(Debug, Default, Serialize)]
struct SplitReport {
    /// Reason why the split is not usable.
    error: Option<String>,
    #[serde(flatten)]
    skips: SkipReport,
    keys: Vec<String>,
    /// Sizes and extents of the used scenes.
    info: Option<SourceInfo>,
}

pub fn run(args: &InfoArgs) -> anyhow::Result<()> {
    let json = args.json.open(&[&args.path])?;
    let report = describe(&args.path)?;
    print_result(&report.to_string())?;
    json.write(&report)?;
    let is_unreadable = |info: &SourceInfo| info.num_frames.is_none() && !info.unreadable.is_empty();
    let is_usable = report.splits.values().all(|split| split.info.as_ref().is_some_and(|info| !is_unreadable(info)));
    anyhow::ensure!(is_usable, "a part of the data is not usable; the table above lists the reason");
    Ok(())
}

fn describe(path: &Path) -> anyhow::Result<Report> {
    let mut report = Report { path: path.to_owned(), ..Report::default() };
    let root = DatasetRoot::find(path)?;
    for split in present_splits(&root, Splits::Both) {
        let name = if root.has_splits { split.to_string() } else { "all".into() };
        let described = match open_source(&root, split, &read_all_options(), &mut scan_counter()) {
            Ok(OpenedSource { source, report: skips, kind, .. }) => {
                report.layout = Some(kind);
                let keys = (0..source.num_scenes()).map(|scene| source.key(scene).to_owned()).collect();
                SplitReport { error: None, skips, keys, info: Some(SourceInfo::read(source.as_ref())) }
            }
            Err(error @ DataError::UnknownLayout { .. }) => return Err(error.into()),
            Err(error) => SplitReport { error: Some(error.to_string()), ..SplitReport::default() },
        };
        report.splits.insert(name, described);
    }
    Ok(report)
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut rows: Vec<(&str, String)> = Vec::new();
        rows.extend(self.layout.map(|layout| ("layout", layout.to_string())));
        let names = if self.splits.contains_key("all") { &["all"][..] } else { &["train", "test"] };
        for name in names {
            match self.splits.get(*name) {
                None => rows.push((name, "not found".into())),
                Some(split) => split.add_rows(name, &mut rows),
            }
        }
        let lines: Vec<String> = rows.iter().map(|(name, value)| format!("{name:<18}{value}")).collect();
        f.write_str(&lines.join("\n"))
    }
}

impl SplitReport {
    fn add_rows<'a>(&self, name: &'a str, rows: &mut Vec<(&'a str, String)>) {
        let Some(info) = &self.info else {
            rows.extend(self.error.iter().map(|error| (name, error.clone())));
            return;
        };
        let SkipReport { num_scenes, skips, notes, .. } = &self.skips;
        let used = if skips.is_empty() { String::new() } else { format!("{} of ", self.skips.num_used()) };
        rows.push((name, format!("{used}{}", plural(*num_scenes, "scene"))));
        if !self.keys.is_empty() {
            rows.push(("  keys", first_of(&self.keys, MAX_LISTED_KEYS)));
        }
        for (name, scenes) in [("  skipped", skips), ("  unreadable", &info.unreadable)] {
            let listed = scenes.iter().take(MAX_LISTED_SCENES);
            rows.extend(listed.map(|SkippedScene { key, reason }| (name, format!("{key}: {reason}"))));
            if scenes.len() > MAX_LISTED_SCENES {
                rows.push((name, format!("{} more scenes", scenes.len() - MAX_LISTED_SCENES)));
            }
        }
        for (reason, names) in self.skips.frame_names() {
            rows.push(("  skipped", format!("{} {reason}: {}", plural(names.len(), "frame"), names.join(", "))));
        }
        rows.extend(notes.iter().map(|note| ("  note", note.clone())));
        rows.extend(info.num_frames.map(|frames| ("  frames", format!("{frames} (smallest / median / largest)"))));
        let mut sizes: Vec<(&String, &usize)> = info.image_sizes.iter().collect();
        sizes.sort_by_key(|(_, count)| std::cmp::Reverse(**count));
        let sizes: Vec<String> = match sizes[..] {
            [(size, _)] => vec![size.clone()],
            _ => sizes.iter().map(|(size, count)| format!("{size} ({})", plural(**count, "scene"))).collect(),
        };
        if !sizes.is_empty() {
            rows.push(("  image", first_of(&sizes, MAX_LISTED_KEYS)));
        }
        rows.extend(info.fov_deg.map(|fov| ("  field of view", format!("{fov:.1} deg"))));
        rows.extend(info.extent.map(|extent| ("  path extent", format!("{extent:.3}"))));
    }
}

/// Joins up to `most` names, with `..` for the others.
fn first_of(names: &[String], most: usize) -> String {
    let more = if names.len() > most { ", .." } else { "" };
    format!("{}{more}", names[..names.len().min(most)].join(", "))
}

#[derive(Debug, clap::Args)]
pub struct InfoArgs {
    /// Data set, or one scene
    #[arg(value_name = "DIR")]
    pub path: PathBuf,
    #[command(flatten)]
    pub json: JsonArg,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fixtures() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../data-fixtures/re10k-mini")
    }

    #[test]
    fn folder_is_described_split_by_split() {
        let text = describe(&fixtures()).unwrap().to_string();
        let expected = "layout            chunks
train             2 scenes
  keys            00000000000000a1, 00000000000000a2
  frames          8 / 8 / 8 (smallest / median / largest)
  image           64x36
  field of view   58.1 / 58.1 / 58.1 deg
  path extent     0.350 / 0.350 / 0.350
test              1 scene
";
        assert!(text.starts_with(expected), "{text}");
    }

    #[test]
    fn skipped_scenes_and_unusable_captures_have_reasons() {
        let root = tempfile::tempdir().unwrap();
        let train = root.path().join("train");
        std::fs::create_dir(&train).unwrap();
        std::fs::copy(fixtures().join("train/000000.torch"), train.join("000000.torch")).unwrap();
        std::fs::write(train.join("000001.torch"), "cut").unwrap();
        let index = r#"{"00000000000000a1": "000000.torch", "elsewhere": "000000.torch", "cut": "000001.torch"}"#;
        std::fs::write(train.join("index.json"), index).unwrap();
        let text = describe(root.path()).unwrap().to_string();
        assert!(text.contains("train             1 of "), "{text}");
        for expected in ["  skipped         cut: bad chunk: ", "  skipped         elsewhere: bad chunk: "] {
            assert!(text.contains(expected), "{text}");
        }
        let capture = tempfile::tempdir().unwrap();
        std::fs::write(capture.path().join("transforms.json"), r#"{"fl_x": 20, "frames": []}"#).unwrap();
        let text = describe(capture.path()).unwrap().to_string();
        assert!(text.starts_with("all               bad scene: no frames listed: "), "{text}");
    }
}
