//! `clift data check`.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context;
use clift_data::{
    CheckedScene, SceneCheck, Split, check_scene, encode_png, note_skipped_frames, replace_file, skipped_scenes,
};
use serde::Serialize;

use crate::commands::data::text::count;
use crate::commands::splits::{SplitSource, Splits, files, splits};
use crate::output::counter::Counter;
use crate::output::stdout::{print_note, print_result};
use crate::output::table;

/// A scene's row, with its half.
#[derive(Debug, Serialize)]
struct Row {
    /// Folder it is in; `None` where there is one folder for all.
    split: Option<Split>,
    #[serde(flatten)]
    check: SceneCheck,
}

/// What `--json` writes.
#[derive(Debug, Serialize)]
struct Report {
    scenes: Vec<Row>,
    /// What is to be known of the whole.
    notes: Vec<String>,
}

/// Checks every scene, prints the table and fails when one is flagged or there is none.
pub fn run(args: &CheckArgs) -> anyhow::Result<()> {
    if let Some(folder) = &args.pictures {
        fs::create_dir_all(folder).with_context(|| format!("making {}", folder.display()))?;
    }
    let mut report = Report { scenes: Vec::new(), notes: Vec::new() };
    for half in splits(&args.dir, args.split, &files(&args.set)?.0)? {
        check_half(&half, args, &mut report)?;
    }
    print_result(&shown(&report))?;
    if let Some(path) = &args.json {
        let text = serde_json::to_vec_pretty(&report).context("writing the report as JSON")?;
        replace_file(path, &text).with_context(|| format!("writing {}", path.display()))?;
    }
    anyhow::ensure!(!report.scenes.is_empty(), "no scene was checked: {}", args.dir.display());
    let flagged = report.scenes.iter().filter(|row| !row.check.ok).count();
    anyhow::ensure!(
        flagged == 0,
        "{flagged} of {} flagged; the reasons stand above",
        count(report.scenes.len(), "scene")
    );
    Ok(())
}

fn check_half(half: &SplitSource, args: &CheckArgs, report: &mut Report) -> anyhow::Result<()> {
    let (source, ledger) = (&half.opened.source, &half.opened.report);
    for note in &ledger.notes {
        print_note(&format!("note: {note}"));
    }
    report.notes.extend_from_slice(&ledger.notes);
    report.scenes.extend(skipped_scenes(ledger).into_iter().map(|check| Row { split: half.split, check }));
    let num_scenes = source.num_scenes().min(args.scenes.unwrap_or(usize::MAX));
    let mut counter = Counter::new(&half.name(), num_scenes as u64);
    for scene in 0..num_scenes {
        let CheckedScene { mut check, image } = check_scene(source.as_ref(), scene);
        note_skipped_frames(ledger, &mut check);
        if let (Some(folder), Some(image)) = (&args.pictures, image) {
            let path = folder.join(picture_name(half.split, &check.key));
            write_picture(&path, &encode_png(&image)?)?;
        }
        report.scenes.push(Row { split: half.split, check });
        counter.set(scene as u64 + 1);
    }
    Ok(())
}

fn write_picture(path: &Path, png: &[u8]) -> anyhow::Result<()> {
    replace_file(path, png).with_context(|| format!("writing {}", path.display()))
}

/// `test-KEY.png`; a key may hold what a file name may not.
fn picture_name(split: Option<Split>, key: &str) -> String {
    let safe = |c: char| if c.is_alphanumeric() || "-_.".contains(c) { c } else { '_' };
    let key: String = key.chars().map(safe).collect();
    split.map_or_else(|| format!("{key}.png"), |split| format!("{split}-{key}.png"))
}

const HEADER: [&str; 6] = ["scene", "frames", "size", "field of view", "epipolar", ""];

fn shown(report: &Report) -> String {
    let mut rows = vec![HEADER.map(String::from)];
    let mut sentences = Vec::new();
    for Row { split, check } in &report.scenes {
        let name = split.map_or_else(|| check.key.clone(), |split| format!("{split}/{}", check.key));
        let or_dash = |text: Option<String>| text.unwrap_or_else(|| "-".into());
        rows.push([
            name.clone(),
            check.num_frames.to_string(),
            or_dash(check.image_size.map(|[width, height]| format!("{width}x{height}"))),
            or_dash(check.fov_deg.map(|fov| format!("{fov:.1} deg"))),
            or_dash(check.epipolar_px.map(|px| format!("{px:.2} px"))),
            if check.ok { "ok" } else { "FLAGGED" }.into(),
        ]);
        sentences.extend(check.reasons.iter().map(|reason| format!("{name}: {reason}")));
        sentences.extend(check.notes.iter().map(|note| format!("{name}: note: {note}")));
    }
    let mut text = table::columns(&rows);
    if !sentences.is_empty() {
        text = format!("{text}\n\n{}", sentences.join("\n"));
    }
    let flagged = report.scenes.iter().filter(|row| !row.check.ok).count();
    let total = count(report.scenes.len(), "scene");
    format!("{text}\n\n{total}, {} ok, {flagged} flagged", report.scenes.len() - flagged)
}

/// Arguments of `clift data check`.
#[derive(Debug, clap::Args)]
pub struct CheckArgs {
    /// Scenes in any layout, or one scene
    pub dir: PathBuf,
    /// Which half, where there are two
    #[arg(long, value_enum, default_value_t = Splits::Both)]
    pub split: Splits,
    /// Check the first N scenes of each half
    #[arg(long, value_name = "N")]
    pub scenes: Option<usize>,
    /// Write what was found as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Write a picture of every scene there: two frames with epipolar lines
    #[arg(long, value_name = "OUT")]
    pub pictures: Option<PathBuf>,
    /// Say where parts of the layout are, as in a config: `--set data.files.image_folder=images_4`
    #[arg(long, value_name = "data.files.KEY=TOML")]
    pub set: Vec<String>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_has_a_row_per_scene_and_a_sentence_per_reason() {
        let good = SceneCheck {
            key: "a".into(),
            ok: true,
            num_frames: 36,
            epipolar_px: Some(0.312),
            image_size: Some([576, 320]),
            fov_deg: Some(93.04),
            ..SceneCheck::default()
        };
        let reasons = vec!["it has no frames".to_owned()];
        let bad = SceneCheck { key: "b".into(), reasons, notes: vec!["so much".into()], ..SceneCheck::default() };
        let report = Report {
            scenes: vec![Row { split: Some(Split::Train), check: good }, Row { split: None, check: bad }],
            notes: Vec::new(),
        };
        let expected = "\
scene    frames  size     field of view  epipolar
train/a  36      576x320  93.0 deg       0.31 px   ok
b        0       -        -              -         FLAGGED

b: it has no frames
b: note: so much

2 scenes, 1 ok, 1 flagged";
        assert_eq!(shown(&report), expected);
        let json = serde_json::to_value(&report).unwrap();
        assert_eq!((&json["scenes"][0]["key"], &json["scenes"][0]["ok"]), (&"a".into(), &true.into()));
        assert_eq!((&json["scenes"][0]["split"], &json["scenes"][1]["split"]), (&"train".into(), &().into()));
        assert_eq!(json["scenes"][1]["reasons"][0], "it has no frames");
        assert!(json["scenes"][1]["epipolar_px"].is_null());
    }

    #[test]
    fn a_picture_is_named_after_its_scene_and_stays_in_its_folder() {
        assert_eq!(picture_name(Some(Split::Test), "00ff"), "test-00ff.png");
        assert_eq!(picture_name(None, "../1K/a b"), ".._1K_a_b.png");
    }
}
