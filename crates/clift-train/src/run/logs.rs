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

/// A file of JSON lines, at most one per step. Every line is flushed; a killed run loses at most the last one.
#[derive(Debug, Default)]
pub struct StepLines {
    /// `None` on a rank other than 0, where no lines are written.
    path: Option<PathBuf>,
    file: Option<File>,
    failure: Option<std::io::Error>,
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
        Ok(Self { path: Some(path.into()), ..Self::default() })
    }

    /// Appends a line. A failure is kept for [`StepLines::check`]; later lines are not written.
    pub fn write(&mut self, line: &impl Serialize) {
        if self.failure.is_none() {
            self.failure = self.try_write(line).err();
        }
    }

    fn try_write(&mut self, line: &impl Serialize) -> std::io::Result<()> {
        let Some(path) = &self.path else { return Ok(()) };
        let file = match &mut self.file {
            Some(file) => file,
            // The first line makes the file.
            none => none.insert(OpenOptions::new().create(true).append(true).open(path)?),
        };
        // One write per line: a kill tears at most the last one.
        file.write_all(format!("{}\n", serde_json::to_string(line)?).as_bytes())
    }

    /// Flushes all lines to the disk, or returns the first failure to write a line.
    pub fn check(&mut self) -> Result<(), TrainError> {
        let flushed = match self.failure.take() {
            Some(failure) => Err(failure),
            None => self.file.as_ref().map_or(Ok(()), File::sync_data),
        };
        flushed.map_err(TrainError::io("writing the log of steps", self.path.as_deref().unwrap_or(Path::new(""))))
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
    time: f64,
}

/// A line of `validation.jsonl`.
#[derive(Serialize)]
struct ValidationLine {
    step: u64,
    stage: Stage,
    psnr: f64,
    /// `null` for images below 11 pixels.
    ssim: Option<f64>,
    num_views: usize,
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
    pub bad_steps: StepLines,
    skips: StepLines,
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
        let (skips, path) = (open("skipped.jsonl", step)?, run_dir.join("skipped.jsonl"));
        let skipped = read_skips(&path).map_err(TrainError::io("reading the log of scenes", &path))?;
        // A validation after the last saved one is made again.
        let (metrics, validations) = (open("metrics.jsonl", step)?, open("validation.jsonl", validated)?);
        Ok(Self { sink, metrics, validations, bad_steps: open("bad_steps.jsonl", step)?, skips, skipped })
    }

    /// Returns a log that only passes events on, of a rank other than 0.
    pub fn silent(sink: &'a mut dyn Sink) -> Self {
        let [metrics, validations, bad_steps, skips] = std::array::from_fn(|_| StepLines::default());
        Self { sink, metrics, validations, bad_steps, skips, skipped: HashSet::new() }
    }

    /// Reports and logs a scene that `step` could not use, once per run.
    pub fn skip(&mut self, stage: Stage, step: u64, skip: &SkippedScene) {
        if self.skipped.insert(skip.key.clone()) {
            self.sink.event(&Event::Skipped { key: skip.key.clone(), reason: skip.reason.clone() });
            self.skips.write(&SkipLine { step, stage, skip: skip.clone() });
        }
    }

    /// Flushes all lines to the disk. Must succeed before a checkpoint is saved, or a resumed run would lack lines.
    pub fn check(&mut self) -> Result<(), TrainError> {
        for lines in [&mut self.metrics, &mut self.validations, &mut self.bad_steps, &mut self.skips] {
            lines.check()?;
        }
        Ok(())
    }
}

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

    const ONE: Stage = Stage::Stage1;
    const TWO: Stage = Stage::Stage2;

    fn step(stage: Stage, step: u64) -> Event {
        Event::Step(StepEvent {
            step,
            stage,
            last_step: 9,
            loss: f64::NAN,
            psnr: f64::INFINITY,
            lr: 1e-3,
            grad_norm: 2.0,
            step_s: 0.25,
            images_per_s: 48.0,
            peak_bytes: None,
        })
    }

    /// Writes to the logs of a run that resumes at a step and its last validation. Returns the number of events passed on.
    fn log(folder: &Path, (stage, from): (Stage, [u64; 2]), write: impl FnOnce(&mut RunLog)) -> usize {
        let mut count = 0;
        let mut sink = |_: &Event| count += 1;
        let mut log = RunLog::open(folder, stage, from, &mut sink).unwrap();
        write(&mut log);
        log.check().unwrap();
        count
    }

    fn steps(path: &Path) -> Vec<(Stage, u64)> {
        let text = std::fs::read_to_string(path).unwrap();
        let lines = text.lines().map(|line| serde_json::from_str::<LinePosition>(line).unwrap());
        lines.map(|line| (line.stage, line.step)).collect()
    }

    #[test]
    fn resuming_drops_later_steps_and_torn_lines() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("metrics.jsonl");
        let write = |stage, from, lines: &[(Stage, u64)]| {
            let passed = log(folder.path(), (stage, [from; 2]), |log| {
                for &(stage, number) in lines {
                    log.event(&step(stage, number));
                }
            });
            assert_eq!(passed, lines.len(), "events are passed on");
        };
        write(ONE, 0, &[(ONE, 1), (ONE, 2), (ONE, 3), (TWO, 1), (TWO, 2)]);
        write(TWO, 1, &[(TWO, 2)]);
        assert_eq!(steps(&path), [(ONE, 1), (ONE, 2), (ONE, 3), (TWO, 1), (TWO, 2)]);
        write(ONE, 2, &[(ONE, 3)]);
        let three = [(ONE, 1), (ONE, 2), (ONE, 3)];
        assert_eq!(steps(&path), three);
        let without_newline = "{\"step\":2,\"stage\":\"stage1\"}";
        for torn in ["{\"step\":2,\"sta", "{\"step\":2,\"sta\n", "\u{0}\u{0}", without_newline] {
            let whole = std::fs::read_to_string(&path).unwrap();
            std::fs::write(&path, whole + torn).unwrap();
            write(ONE, 5, &[]);
            assert_eq!(steps(&path), three);
        }
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
        // A file of another program is left alone.
        std::fs::write(&path, "a diary\nof days\n").unwrap();
        assert_eq!(StepLines::open(&path, ONE, 0).unwrap_err().to_string(), "line 1 has no step");
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "a diary\nof days\n");
    }

    #[test]
    fn validations_after_the_saved_one_are_made_again() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("validation.jsonl");
        log(folder.path(), (ONE, [0; 2]), |log| {
            for (step, psnr) in [(2, 20.5), (4, f64::NAN), (6, 21.0)] {
                log.event(&Event::Evaluated { stage: ONE, step, psnr, ssim: Some(0.5), num_views: 3 });
            }
        });
        let text = std::fs::read_to_string(&path).unwrap();
        let first = "{\"step\":2,\"stage\":\"stage1\",\"psnr\":20.5,\"ssim\":0.5,\"num_views\":3,\"time\":";
        assert!(text.starts_with(first), "{text}");
        assert_eq!(steps(&path), [(ONE, 2), (ONE, 6)], "a result without value is none");
        // The checkpoint of step 6 was saved before its validation.
        log(folder.path(), (ONE, [6, 2]), |_| {});
        assert_eq!(steps(&path), [(ONE, 2)]);
    }

    #[test]
    fn write_failure_is_reported_and_ends_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("missing/metrics.jsonl");
        let mut lines = StepLines::open(&path, ONE, 0).unwrap();
        lines.write(&1);
        std::fs::create_dir(folder.path().join("missing")).unwrap();
        lines.write(&2);
        assert!(!path.exists(), "a file with a gap would look complete");
        assert!(lines.check().unwrap_err().to_string().contains("No such file"));
    }

    #[test]
    fn skipped_scenes_are_reported_once_across_resumptions() {
        let folder = tempfile::tempdir().unwrap();
        let skip = |log: &mut RunLog, step, key: &str| {
            log.skip(ONE, step, &SkippedScene { key: key.into(), reason: "torn".into() });
        };
        let write = |from, lines: &[(u64, &str)]| {
            log(folder.path(), (ONE, [from; 2]), |log| lines.iter().for_each(|(step, key)| skip(log, *step, key)))
        };
        assert_eq!(write(0, &[(1, "a"), (2, "a"), (3, "b")]), 2);
        // Resumed after step 2: the line of step 3 is dropped and written again.
        assert_eq!(write(2, &[(3, "b"), (4, "a")]), 1);
        assert_eq!(
            std::fs::read_to_string(folder.path().join("skipped.jsonl")).unwrap(),
            "{\"step\":1,\"stage\":\"stage1\",\"key\":\"a\",\"reason\":\"torn\"}\n\
             {\"step\":3,\"stage\":\"stage1\",\"key\":\"b\",\"reason\":\"torn\"}\n"
        );
    }
}
