//! `clift metrics`.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::Context;
use clift_core::replace_file;
use clift_train::Stage;
use serde::Deserialize;

use crate::commands::args::shared_args::require_free;
use crate::exit_code::usage_bail;
use crate::output::stdout::print_result;
use crate::output::tensorboard::{Scalar, event_file};

/// Columns of a step, as in `metrics.jsonl`.
const STEP_KEYS: [&str; 5] = ["loss", "psnr", "lr", "grad_norm", "step_s"];
/// Columns of a validation, as in `validation.jsonl`.
const VALIDATION_KEYS: [&str; 3] = ["psnr", "ssim", "num_views"];

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
    step: BTreeMap<String, Option<f64>>,
    validation: BTreeMap<String, Option<f64>>,
}

/// Rows by stage and step.
type Rows = BTreeMap<(Stage, u64), Row>;

/// Reads the metrics of a run and writes them in another format.
pub fn run(args: &MetricsArgs) -> anyhow::Result<()> {
    if args.csv.is_none() && args.tensorboard.is_none() {
        usage_bail!("set --csv FILE, --tensorboard DIR or both");
    }
    let rows = read_rows(&args.run)?;
    if let Some(path) = &args.csv {
        require_free(path, args.force)?;
        write(path, &csv(&rows))?;
    }
    if let Some(folder) = &args.tensorboard {
        for stage in [Stage::Stage1, Stage::Stage2] {
            let path = folder.join(stage.name()).join("events.out.tfevents.0.clift");
            let Some(((_, _), first)) = rows.iter().find(|((found, _), _)| *found == stage) else { continue };
            require_free(&path, args.force)?;
            write(&path, &event_file(first.time, scalars(&rows, stage)))?;
        }
    }
    Ok(())
}

fn read_rows(run: &Path) -> anyhow::Result<Rows> {
    let mut rows = Rows::new();
    for (name, is_step) in [("metrics.jsonl", true), ("validation.jsonl", false)] {
        let path = run.join(name);
        // Runs without validation lack the second.
        if !is_step && !path.exists() {
            continue;
        }
        let text = std::fs::read_to_string(&path).with_context(|| format!("reading {}", path.display()))?;
        // A run that is training may have written a part of its last line.
        let whole = text.rfind('\n').map_or("", |end| &text[..end]);
        for (number, line) in whole.lines().enumerate() {
            let bad = || format!("line {} of {} holds no metrics", number + 1, path.display());
            let line: Line = serde_json::from_str(line).with_context(bad)?;
            let row = rows.entry((line.stage, line.step)).or_default();
            if is_step {
                (row.time, row.step) = (line.time, line.values);
            } else {
                row.validation = line.values;
            }
        }
    }
    Ok(rows)
}

fn csv(rows: &Rows) -> Vec<u8> {
    let mut text = format!("stage,step,time,{}", STEP_KEYS.join(","));
    for key in VALIDATION_KEYS {
        let _ = write!(text, ",validation_{key}");
    }
    text.push('\n');
    for ((stage, step), row) in rows {
        let _ = write!(text, "{},{step},{}", stage.name(), row.time);
        let cells = STEP_KEYS.iter().map(|key| (&row.step, key));
        for (values, key) in cells.chain(VALIDATION_KEYS.iter().map(|key| (&row.validation, key))) {
            let value = values.get(*key).copied().flatten();
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
        let tags = [
            ("train/loss", &row.step, "loss"),
            ("train/psnr", &row.step, "psnr"),
            ("train/learning_rate", &row.step, "lr"),
            ("train/grad_norm", &row.step, "grad_norm"),
            ("train/step_s", &row.step, "step_s"),
            ("validation/psnr", &row.validation, "psnr"),
            ("validation/ssim", &row.validation, "ssim"),
        ];
        tags.map(|(tag, values, key)| {
            let value = values.get(key).map(|value| value.unwrap_or(f64::NAN));
            value.map(|value| Scalar { tag, step, time: row.time, value })
        })
        .into_iter()
        .flatten()
        .collect::<Vec<_>>()
    })
}

fn write(path: &Path, content: &[u8]) -> anyhow::Result<()> {
    let writing = || format!("writing {}", path.display());
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder).with_context(writing)?;
    }
    replace_file(path, content).with_context(writing)?;
    print_result(&path.display().to_string())
}

/// Arguments of `clift metrics`.
#[derive(Debug, clap::Args)]
pub struct MetricsArgs {
    /// Run directory, also of a run that is training
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
                 \"step_s\":0.25,\"time\":100.5}}\n"
            )
        };
        write("metrics.jsonl", &(step(1, "0.5") + &step(2, "null") + "{\"step\":3,\"sta"));
        write(
            "validation.jsonl",
            "{\"step\":2,\"stage\":\"stage1\",\"psnr\":18.0,\"ssim\":null,\"num_views\":6,\"time\":101.0}\n",
        );
        let rows = read_rows(folder.path()).unwrap();
        let expected = "\
stage,step,time,loss,psnr,lr,grad_norm,step_s,validation_psnr,validation_ssim,validation_num_views
stage1,1,100.5,0.5,20.5,0.001,2,0.25,,,
stage1,2,100.5,,20.5,0.001,2,0.25,18,,6
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
