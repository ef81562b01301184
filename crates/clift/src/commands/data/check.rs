//! `clift data check`.

use clift_core::plural;
use clift_data::{SceneCheck, Split, Verdict, check_scene, note_skipped_frames, skipped_scenes};
use clift_eval::table;
use serde::Serialize;

use crate::commands::args::shared_args::JsonArg;
use crate::commands::args::splits::{SourceArgs, SplitSource, Splits};
use crate::output::counter::Counter;
use crate::output::stdout::{print_note, print_result};
use crate::output::visible::visible_line;

#[derive(Debug, Serialize)]
struct Row {
    /// Split of the scene; `None` for a data set without splits.
    split: Option<Split>,
    #[serde(flatten)]
    check: SceneCheck,
}

#[derive(Debug, Serialize)]
struct Report {
    scenes: Vec<Row>,
    notes: Vec<String>,
}

impl Report {
    fn count(&self, verdict: Verdict) -> usize {
        self.scenes.iter().filter(|row| row.check.verdict == verdict).count()
    }
}

/// Checks every scene and prints the table; fails if a scene is flagged, or if there are none.
pub fn run(args: &CheckArgs) -> anyhow::Result<()> {
    let json = args.json.open(&[&args.source.dir])?;
    let mut report = Report { scenes: Vec::new(), notes: Vec::new() };
    for split in args.source.open(args.split)? {
        check_split(&split, args.scenes, &mut report);
    }
    print_result(&report_text(&report))?;
    json.write(&report)?;
    anyhow::ensure!(!report.scenes.is_empty(), "no scenes to check in {}", args.source.dir.display());
    let flagged = report.count(Verdict::Flagged);
    anyhow::ensure!(
        flagged == 0,
        "{flagged} of {} flagged; the table above lists the reasons",
        plural(report.scenes.len(), "scene")
    );
    Ok(())
}

fn check_split(split: &SplitSource, most: Option<usize>, report: &mut Report) {
    let (source, skips) = (&split.opened.source, &split.opened.report);
    for note in &skips.notes {
        print_note(&format!("note: {note}"));
    }
    report.notes.extend_from_slice(&skips.notes);
    report.scenes.extend(skipped_scenes(skips).into_iter().map(|check| Row { split: split.split, check }));
    let num_scenes = source.num_scenes().min(most.unwrap_or(usize::MAX));
    let mut counter = Counter::new(&split.name(), num_scenes as u64);
    for scene in 0..num_scenes {
        let mut check = check_scene(source.as_ref(), scene);
        note_skipped_frames(skips, &mut check);
        report.scenes.push(Row { split: split.split, check });
        counter.set(scene as u64 + 1);
    }
}

fn report_text(report: &Report) -> String {
    let mut rows = Vec::new();
    let mut sentences = Vec::new();
    for Row { split, check } in &report.scenes {
        let name = split.map_or_else(|| check.key.clone(), |split| format!("{split}/{}", check.key));
        let name = visible_line(&name).into_owned();
        let or_dash = |text: Option<String>| text.unwrap_or_else(|| "-".into());
        rows.push([
            name.clone(),
            check.num_frames.to_string(),
            or_dash(check.image_size.map(|[width, height]| format!("{width}x{height}"))),
            or_dash(check.fov_deg.map(|fov| format!("{fov:.1} deg"))),
            or_dash(check.epipolar_px.map(|px| format!("{px:.2} px"))),
            check.verdict.to_string(),
        ]);
        sentences.extend(check.reasons.iter().map(|reason| format!("{name}: {reason}")));
        sentences.extend(check.notes.iter().map(|note| format!("{name}: note: {note}")));
    }
    let mut text = table(["scene", "frames", "size", "field of view", "epipolar", ""], rows);
    if !sentences.is_empty() {
        text = format!("{text}\n\n{}", sentences.join("\n"));
    }
    let [ok, flagged, not_compared] =
        [Verdict::Ok, Verdict::Flagged, Verdict::NotCompared].map(|verdict| report.count(verdict));
    let num_scenes = plural(report.scenes.len(), "scene");
    let mut counts = format!("{num_scenes}, {ok} ok, {flagged} flagged");
    if not_compared > 0 {
        counts = format!("{counts}, {not_compared} not compared with the images");
    }
    format!("{text}\n\n{counts}")
}

#[derive(Debug, clap::Args)]
pub struct CheckArgs {
    #[command(flatten)]
    pub source: SourceArgs,
    /// Check this split, if there are two
    #[arg(long, value_enum, default_value_t = Splits::Both)]
    pub split: Splits,
    /// Check the first N scenes of each split
    #[arg(long, value_name = "N")]
    pub scenes: Option<usize>,
    #[command(flatten)]
    pub json: JsonArg,
}
