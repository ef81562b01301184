//! Logs of a run: `metrics.jsonl`, `validation.jsonl`, `bad_steps.jsonl` and `skipped.jsonl`.

use std::collections::HashSet;
use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use clift_data::SkippedScene;
use serde::{Deserialize, Serialize};

use crate::error::TrainError;
use crate::events::{Event, Sink, Stage, StepEvent};
use crate::step::step_guard::SkippedStep;

/// A file of JSON lines, at most one per step. Every line is flushed; a killed run loses at most the last one.
#[derive(Debug)]
pub struct StepLines {
    path: PathBuf,
    /// Opened by the first line.
    file: Option<File>,
    failure: Option<std::io::Error>,
    /// Whether lines are dropped.
    is_silent: bool,
}

impl StepLines {
    /// Opens the file of a run that resumes after `step` updates of `stage`, or starts the stage at 0.
    ///
    /// Lines of later steps and stages are dropped, since they will be written again, and so is a torn last line. The
    /// shortened file replaces the old one by a rename.
    ///
    /// # Errors
    /// Those of the operating system, and `InvalidData` for a line before the last that has no step: such a file is not
    /// changed.
    pub fn open(path: &Path, stage: Stage, step: u64) -> std::io::Result<Self> {
        if path.exists() {
            truncate_after(path, stage, step)?;
        }
        Ok(Self { path: path.to_owned(), file: None, failure: None, is_silent: false })
    }

    /// Returns lines that are not written, of a rank other than 0.
    fn silent() -> Self {
        Self { path: PathBuf::new(), file: None, failure: None, is_silent: true }
    }

    /// Appends a line. A failure is kept for [`StepLines::check`]; later lines are not written.
    pub fn write(&mut self, line: &impl Serialize) {
        if self.failure.is_none() && !self.is_silent {
            self.failure = self.try_write(line).err();
        }
    }

    fn try_write(&mut self, line: &impl Serialize) -> std::io::Result<()> {
        let file = match &mut self.file {
            Some(file) => file,
            none => none.insert(OpenOptions::new().create(true).append(true).open(&self.path)?),
        };
        // One write per line: a kill tears at most the last one.
        file.write_all(format!("{}\n", serde_json::to_string(line)?).as_bytes())
    }

    /// Flushes all lines to the disk, or returns the first failure to write a line.
    pub fn check(&mut self) -> std::io::Result<()> {
        if let Some(failure) = self.failure.take() {
            return Err(failure);
        }
        self.file.as_ref().map_or(Ok(()), File::sync_data)
    }

    pub fn path(&self) -> &Path {
        &self.path
    }
}

#[derive(Deserialize)]
struct LinePosition {
    step: u64,
    stage: Stage,
}

fn truncate_after(path: &Path, stage: Stage, step: u64) -> std::io::Result<()> {
    let mut kept = Vec::new();
    let mut broken: Option<usize> = None;
    let mut is_whole = true;
    let mut reader = BufReader::new(File::open(path)?);
    for number in 1.. {
        let mut line = Vec::new();
        if reader.read_until(b'\n', &mut line)? == 0 {
            break;
        }
        if let Some(number) = broken {
            return Err(std::io::Error::new(std::io::ErrorKind::InvalidData, format!("line {number} has no step")));
        }
        match serde_json::from_slice::<LinePosition>(&line) {
            // A line without newline may be torn even if it can be parsed.
            Ok(found) if line.ends_with(b"\n") && (found.stage, found.step) <= (stage, step) => kept.extend(line),
            Ok(_) => is_whole = false,
            Err(_) => (is_whole, broken) = (false, Some(number)),
        }
    }
    if is_whole { Ok(()) } else { clift_core::replace_file(path, &kept) }
}

/// A line of `skipped.jsonl`: a scene that could not be used, at its first step.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SkipLine {
    pub step: u64,
    pub stage: Stage,
    #[serde(flatten)]
    pub skip: SkippedScene,
}

/// A line of `metrics.jsonl`: an update, and when it ended.
#[derive(Serialize)]
struct StepLine<'a> {
    #[serde(flatten)]
    step: &'a StepEvent,
    /// Seconds since 1970, UTC.
    time: f64,
}

/// A line of `validation.jsonl`.
#[derive(Serialize)]
struct ValidationLine {
    step: u64,
    stage: Stage,
    /// Mean over views, in dB.
    psnr: f64,
    /// `null` for images below 11 pixels.
    ssim: Option<f64>,
    num_views: usize,
    /// Seconds since 1970, UTC.
    time: f64,
}

/// Returns the seconds since 1970, to the millisecond.
fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |time| time.as_millis() as f64 / 1e3)
}

/// The logs of a stage in front of another sink: a line per step in `metrics.jsonl`, per validation in `validation.jsonl`,
/// per skipped step in `bad_steps.jsonl`, and per skipped scene in `skipped.jsonl`.
pub struct RunLog<'a> {
    sink: &'a mut dyn Sink,
    metrics: StepLines,
    validations: StepLines,
    bad_steps: StepLines,
    skips: StepLines,
    /// Scenes that have a line.
    skipped: HashSet<String>,
}

impl<'a> RunLog<'a> {
    /// Opens the files in `run_dir` after `step` updates of `stage`, the last validated one of which is `validated`, as
    /// [`StepLines::open`].
    pub fn open(
        run_dir: &Path,
        stage: Stage,
        [step, validated]: [u64; 2],
        sink: &'a mut dyn Sink,
    ) -> Result<Self, TrainError> {
        let open = |name: &str, step: u64| {
            let path = run_dir.join(name);
            StepLines::open(&path, stage, step).map_err(TrainError::io("opening the log of steps", &path))
        };
        let skips = open("skipped.jsonl", step)?;
        let skipped = read_skips(skips.path()).map_err(TrainError::io("reading the log of scenes", skips.path()))?;
        // A validation after the last saved one is made again.
        let (metrics, validations) = (open("metrics.jsonl", step)?, open("validation.jsonl", validated)?);
        Ok(Self { sink, metrics, validations, bad_steps: open("bad_steps.jsonl", step)?, skips, skipped })
    }

    /// Returns a log that only passes events on, of a rank other than 0.
    pub fn silent(sink: &'a mut dyn Sink) -> Self {
        let [metrics, validations, bad_steps, skips] = std::array::from_fn(|_| StepLines::silent());
        Self { sink, metrics, validations, bad_steps, skips, skipped: HashSet::new() }
    }

    /// Reports and logs a scene that `step` could not use, once per run.
    pub fn skip(&mut self, stage: Stage, step: u64, skip: &SkippedScene) {
        if self.skipped.insert(skip.key.clone()) {
            self.sink.event(&Event::Skipped { key: skip.key.clone(), reason: skip.reason.clone() });
            self.skips.write(&SkipLine { step, stage, skip: skip.clone() });
        }
    }

    pub fn bad_step(&mut self, line: &SkippedStep) {
        self.bad_steps.write(line);
    }

    /// Flushes all lines to the disk. Must succeed before a checkpoint is saved, or a resumed run would lack lines.
    pub fn check(&mut self) -> Result<(), TrainError> {
        for lines in [&mut self.metrics, &mut self.validations, &mut self.bad_steps, &mut self.skips] {
            lines.check().map_err(TrainError::io("writing the log of steps", lines.path()))?;
        }
        Ok(())
    }
}

/// Reads the keys of the scenes that have a line.
fn read_skips(path: &Path) -> std::io::Result<HashSet<String>> {
    if !path.exists() {
        return Ok(HashSet::new());
    }
    let text = std::fs::read_to_string(path)?;
    text.lines().map(|line| Ok(serde_json::from_str::<SkipLine>(line)?.skip.key)).collect()
}

impl Sink for RunLog<'_> {
    fn event(&mut self, event: &Event) {
        self.sink.event(event);
        match *event {
            Event::Step(ref step) => self.metrics.write(&StepLine { step, time: now() }),
            Event::Evaluated { stage, step, psnr, ssim, num_views } if psnr.is_finite() => {
                self.validations.write(&ValidationLine { step, stage, psnr, ssim, num_views, time: now() });
            }
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::step::step_guard::StepAnomaly;

    const STEP: StepEvent = StepEvent {
        step: 1,
        stage: Stage::Stage1,
        last_step: 9,
        last_step_of_size: 9,
        loss: f64::NAN,
        psnr: f64::INFINITY,
        lr: 1e-3,
        grad_norm: 2.0,
        step_s: 0.25,
        images_per_s: 48.0,
        peak_bytes: None,
    };

    #[derive(Default)]
    struct Count(usize);

    impl Sink for Count {
        fn event(&mut self, _event: &Event) {
            self.0 += 1;
        }
    }

    /// Writes steps to `metrics.jsonl` of a run that resumes at `from`.
    fn write(path: &Path, from: (Stage, u64), steps: &[(Stage, u64)]) {
        let mut count = Count::default();
        let mut log = RunLog::open(path.parent().unwrap(), from.0, [from.1; 2], &mut count).unwrap();
        for &(stage, step) in steps {
            log.event(&Event::Step(StepEvent { step, stage, ..STEP }));
        }
        log.check().unwrap();
        assert_eq!(count.0, steps.len(), "events are passed on");
    }

    fn steps(path: &Path) -> Vec<(Stage, u64)> {
        let text = std::fs::read_to_string(path).unwrap();
        let lines = text.lines().map(|line| serde_json::from_str::<LinePosition>(line).unwrap());
        lines.map(|line| (line.stage, line.step)).collect()
    }

    #[test]
    fn lines_have_documented_names_and_null_for_non_finite_values() {
        let folder = tempfile::tempdir().unwrap();
        let mut count = Count::default();
        let mut log = RunLog::open(folder.path(), Stage::Stage1, [0; 2], &mut count).unwrap();
        log.event(&Event::Message("not a step".into()));
        log.event(&Event::Step(STEP));
        let bad = |step| SkippedStep {
            step,
            stage: Stage::Stage1,
            reason: StepAnomaly::LossSpike,
            loss: Some(2.0),
            grad_norm: None,
            median_loss: Some(0.5),
            median_grad_norm: Some(1.0),
            in_a_row: 1,
            scenes: Vec::new(),
        };
        assert!(!folder.path().join("bad_steps.jsonl").exists(), "made by the first skipped step");
        log.bad_step(&bad(3));
        log.bad_step(&bad(5));
        // Before `check`: every line is flushed. Resuming after step 4 drops the line of step 5.
        RunLog::open(folder.path(), Stage::Stage1, [4; 2], &mut Count::default()).unwrap();
        let read = |name: &str| std::fs::read_to_string(folder.path().join(name)).unwrap();
        let text = read("metrics.jsonl");
        let (line, time) = text.split_once(",\"time\":").unwrap();
        assert_eq!(
            line,
            "{\"step\":1,\"stage\":\"stage1\",\"loss\":null,\"psnr\":null,\"lr\":0.001,\"grad_norm\":2.0,\"step_s\":0.25,\"images_per_s\":48.0,\"peak_bytes\":null"
        );
        let time: f64 = time.trim_end_matches("}\n").parse().unwrap();
        assert!((now() - time).abs() < 60.0, "{time}");
        assert_eq!(
            read("bad_steps.jsonl"),
            "{\"step\":3,\"stage\":\"stage1\",\"reason\":\"loss_spike\",\"loss\":2.0,\"grad_norm\":null,\
             \"median_loss\":0.5,\"median_grad_norm\":1.0,\"in_a_row\":1,\"scenes\":[]}\n"
        );
    }

    #[test]
    fn resuming_drops_later_steps_and_torn_lines() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("metrics.jsonl");
        let (one, two) = (Stage::Stage1, Stage::Stage2);
        write(&path, (one, 0), &[(one, 1), (one, 2), (one, 3), (two, 1), (two, 2)]);
        write(&path, (two, 1), &[(two, 2)]);
        assert_eq!(steps(&path), [(one, 1), (one, 2), (one, 3), (two, 1), (two, 2)]);
        write(&path, (one, 2), &[(one, 3)]);
        assert_eq!(steps(&path), [(one, 1), (one, 2), (one, 3)]);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
        let without_newline = "{\"step\":2,\"stage\":\"stage1\"}";
        for torn in ["{\"step\":2,\"sta", "{\"step\":2,\"sta\n", "\u{0}\u{0}", without_newline] {
            let whole = std::fs::read_to_string(&path).unwrap();
            std::fs::write(&path, whole + torn).unwrap();
            write(&path, (one, 5), &[]);
            assert_eq!(steps(&path), [(one, 1), (one, 2), (one, 3)]);
        }
    }

    #[test]
    fn validations_after_the_saved_one_are_made_again() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("validation.jsonl");
        let mut count = Count::default();
        let validation =
            |step, psnr| Event::Evaluated { stage: Stage::Stage1, step, psnr, ssim: Some(0.5), num_views: 3 };
        let mut log = RunLog::open(folder.path(), Stage::Stage1, [0; 2], &mut count).unwrap();
        for (step, psnr) in [(2, 20.5), (4, f64::NAN), (6, 21.0)] {
            log.event(&validation(step, psnr));
        }
        log.check().unwrap();
        assert!(
            std::fs::read_to_string(&path)
                .unwrap()
                .starts_with("{\"step\":2,\"stage\":\"stage1\",\"psnr\":20.5,\"ssim\":0.5,\"num_views\":3,\"time\":")
        );
        assert_eq!(steps(&path), [(Stage::Stage1, 2), (Stage::Stage1, 6)], "a result without value is none");
        // The checkpoint of step 6 was saved before its validation.
        RunLog::open(folder.path(), Stage::Stage1, [6, 2], &mut count).unwrap();
        assert_eq!(steps(&path), [(Stage::Stage1, 2)]);
    }

    #[test]
    fn foreign_files_are_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("metrics.jsonl");
        std::fs::write(&path, "a diary\nof days\n").unwrap();
        let error = StepLines::open(&path, Stage::Stage1, 0).unwrap_err();
        assert_eq!(error.to_string(), "line 1 has no step");
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "a diary\nof days\n");
    }

    #[test]
    fn write_failure_is_reported_and_ends_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("missing/metrics.jsonl");
        let mut lines = StepLines::open(&path, Stage::Stage1, 0).unwrap();
        lines.write(&1);
        std::fs::create_dir(folder.path().join("missing")).unwrap();
        lines.write(&2);
        assert!(!path.exists(), "a file with a gap would look complete");
        assert_eq!(lines.check().unwrap_err().kind(), std::io::ErrorKind::NotFound);
    }

    #[test]
    fn skipped_scenes_are_reported_once_across_resumptions() {
        let folder = tempfile::tempdir().unwrap();
        let skip = |key: &str, reason: &str| SkippedScene { key: key.into(), reason: reason.into() };
        let mut count = Count::default();
        let mut log = RunLog::open(folder.path(), Stage::Stage1, [0; 2], &mut count).unwrap();
        log.skip(Stage::Stage1, 1, &skip("a", "torn"));
        log.skip(Stage::Stage1, 2, &skip("a", "torn at another frame"));
        log.skip(Stage::Stage1, 3, &skip("b", "torn"));
        log.check().unwrap();
        assert_eq!(count.0, 2);
        // Resumed after step 2: the line of step 3 is dropped and written again.
        let mut log = RunLog::open(folder.path(), Stage::Stage1, [2; 2], &mut count).unwrap();
        log.skip(Stage::Stage1, 3, &skip("b", "torn"));
        log.skip(Stage::Stage1, 4, &skip("a", "torn"));
        log.check().unwrap();
        assert_eq!(count.0, 3);
        assert_eq!(
            std::fs::read_to_string(folder.path().join("skipped.jsonl")).unwrap(),
            "{\"step\":1,\"stage\":\"stage1\",\"key\":\"a\",\"reason\":\"torn\"}\n\
             {\"step\":3,\"stage\":\"stage1\",\"key\":\"b\",\"reason\":\"torn\"}\n"
        );
    }
}
