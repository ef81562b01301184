//! `clift metrics`.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::Context;
use clift_train::Stage;
use serde::Deserialize;

use crate::commands::args::parse::parse_run;
use crate::exit_code::usage_bail;
use crate::output::output_file::OutputFile;
use crate::output::stdout::print_result;
use crate::output::tensorboard::{Scalar, event_file};

/// Stages with curves.
const STAGES: [Stage; 2] = [Stage::Stage1, Stage::Stage2];
/// Columns of the CSV with their TensorBoard tags: keys of `metrics.jsonl`, then those of `validation.jsonl` with a prefix.
const CURVES: [(&str, Option<&str>); 10] = [
    ("loss", Some("train/loss")),
    ("psnr", Some("train/psnr")),
    ("lr", Some("train/learning_rate")),
    ("grad_norm", Some("train/grad_norm")),
    ("step_s", Some("train/step_s")),
    ("images_per_s", Some("train/images_per_s")),
    ("peak_bytes", Some("train/peak_bytes")),
    ("validation_psnr", Some("validation/psnr")),
    ("validation_ssim", Some("validation/ssim")),
    ("validation_num_views", None),
];

/// A line of either file.
#[derive(Debug, Deserialize)]
struct Line {
    stage: Stage,
    step: u64,
    time: f64,
    /// `null` for values that are not finite.
    #[serde(flatten)]
    values: BTreeMap<String, Option<f64>>,
}

/// A step with its validation.
#[derive(Debug, Default)]
struct Row {
    time: f64,
    /// Values by column.
    values: BTreeMap<String, Option<f64>>,
}

/// Rows by stage and step.
type Rows = BTreeMap<(Stage, u64), Row>;

/// Reads the metrics of a run and writes them in another format.
pub fn run(args: &MetricsArgs) -> anyhow::Result<()> {
    if args.csv.is_none() && args.tensorboard.is_none() {
        usage_bail!("set --csv FILE, --tensorboard DIR or both");
    }
    let rows = read_rows(&args.run)?;
    let mut files: Vec<(PathBuf, Vec<u8>)> = args.csv.iter().map(|path| (path.clone(), csv(&rows))).collect();
    for (folder, stage) in args.tensorboard.iter().flat_map(|folder| STAGES.map(|stage| (folder, stage))) {
        let Some((_, first)) = rows.iter().find(|((found, _), _)| *found == stage) else { continue };
        let path = folder.join(stage.name()).join("events.out.tfevents.0.clift");
        files.push((path, event_file(first.time, scalars(&rows, stage))));
    }
    let check = |(path, content)| Ok((OutputFile::new(path, args.force, &[&args.run])?, content));
    let files = files.iter().map(|(path, content)| check((path, content))).collect::<anyhow::Result<Vec<_>>>()?;
    for (file, content) in files {
        file.write(content)?;
        print_result(&file.path().display().to_string())?;
    }
    Ok(())
}

fn read_rows(run: &Path) -> anyhow::Result<Rows> {
    let mut rows = Rows::new();
    for (name, prefix) in [("metrics.jsonl", ""), ("validation.jsonl", "validation_")] {
        let is_step = prefix.is_empty();
        let path = run.join(name);
        // Runs without validation lack the second.
        if !is_step && !path.exists() {
            continue;
        }
        let text = std::fs::read_to_string(&path)
            .with_context(|| format!("reading {}, which the first step writes", path.display()))?;
        // A run that is training may have written a part of its last line.
        let whole = text.rfind('\n').map_or("", |end| &text[..end]);
        for (number, line) in whole.lines().enumerate() {
            let bad = || format!("line {} of {} holds no metrics", number + 1, path.display());
            let line: Line = serde_json::from_str(line).with_context(bad)?;
            let row = rows.entry((line.stage, line.step)).or_default();
            if is_step {
                row.time = line.time;
            }
            row.values.extend(line.values.into_iter().map(|(key, value)| (format!("{prefix}{key}"), value)));
        }
    }
    Ok(rows)
}

fn csv(rows: &Rows) -> Vec<u8> {
    let mut text = format!("stage,step,time,{}\n", CURVES.map(|(column, _)| column).join(","));
    for ((stage, step), row) in rows {
        let _ = write!(text, "{},{step},{}", stage.name(), row.time);
        for (column, _) in CURVES {
            let value = row.values.get(column).copied().flatten();
            text += &value.map_or_else(|| ",".into(), |value| format!(",{value}"));
        }
        text.push('\n');
    }
    text.into_bytes()
}

/// Returns the curves of a stage; values that are not finite are NaN.
fn scalars(rows: &Rows, stage: Stage) -> impl Iterator<Item = Scalar<'static>> {
    let of_stage = rows.iter().filter(move |((found, _), _)| *found == stage);
    of_stage.flat_map(|(&(_, step), row)| {
        CURVES.into_iter().filter_map(move |(column, tag)| {
            let value = row.values.get(column)?.unwrap_or(f64::NAN);
            Some(Scalar { tag: tag?, step, time: row.time, value })
        })
    })
}

#[derive(Debug, clap::Args)]
pub struct MetricsArgs {
    /// Run directory, also of a run that is training
    #[arg(value_parser = parse_run)]
    pub run: PathBuf,
    /// Write a row per step, with the validation of the step
    #[arg(long, value_name = "FILE")]
    pub csv: Option<PathBuf>,
    /// Write event files for TensorBoard, one per stage
    #[arg(long, value_name = "DIR")]
    pub tensorboard: Option<PathBuf>,
    /// Replace existing files
    #[arg(long)]
    pub force: bool,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_join_steps_with_their_validation() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
        let step = |step: u64, loss: &str| {
            format!(
                "{{\"step\":{step},\"stage\":\"stage1\",\"loss\":{loss},\"psnr\":20.5,\"lr\":0.001,\"grad_norm\":2.0,\
                 \"step_s\":0.25,\"images_per_s\":48.0,\"time\":100.5}}\n"
            )
        };
        write("metrics.jsonl", &(step(1, "0.5") + &step(2, "null") + "{\"step\":3,\"sta"));
        write(
            "validation.jsonl",
            "{\"step\":2,\"stage\":\"stage1\",\"psnr\":18.0,\"ssim\":null,\"num_views\":6,\"time\":101.0}\n",
        );
        let rows = read_rows(folder.path()).unwrap();
        let expected = "\
stage,step,time,loss,psnr,lr,grad_norm,step_s,images_per_s,peak_bytes,validation_psnr,validation_ssim,validation_num_views
stage1,1,100.5,0.5,20.5,0.001,2,0.25,48,,,,
stage1,2,100.5,,20.5,0.001,2,0.25,48,,18,,6
";
        assert_eq!(String::from_utf8(csv(&rows)).unwrap(), expected);
        let scalars: Vec<_> = scalars(&rows, Stage::Stage1).collect();
        let of = |tag: &str| -> Vec<(u64, f64)> {
            scalars.iter().filter(|scalar| scalar.tag == tag).map(|scalar| (scalar.step, scalar.value)).collect()
        };
        assert_eq!((of("train/psnr"), of("validation/psnr")), (vec![(1, 20.5), (2, 20.5)], vec![(2, 18.0)]));
        assert!(of("train/loss")[1].1.is_nan());
        write("metrics.jsonl", "a diary\n");
        let message = format!("{:#}", read_rows(folder.path()).unwrap_err());
        assert!(message.contains("line 1 of ") && message.contains("metrics.jsonl holds no metrics"), "{message}");
    }
}
