//! What a run writes step by step: `metrics.jsonl`, `bad_steps.jsonl` and `skipped.jsonl`.

use std::collections::HashSet;
use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};

use clift_data::SkippedScene;
use serde::{Deserialize, Serialize};

use crate::error::TrainError;
use crate::events::{Event, Sink, Stage, StepEvent};
use crate::step::step_guard::SkippedStep;

/// One line of `metrics.jsonl`. JSON holds no NaN and no infinity: such a number is `null`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MetricsLine {
    /// Updates so far in this stage, from 1.
    pub step: u64,
    /// Which stage.
    pub stage: Stage,
    /// Training loss of the batch.
    pub loss: Option<f64>,
    /// PSNR of the batch in dB.
    pub psnr: Option<f64>,
    /// Learning rate of the first parameter group.
    pub lr: Option<f64>,
    /// Global norm of the gradient before clipping.
    pub grad_norm: Option<f64>,
    /// Seconds of wall time.
    pub step_s: Option<f64>,
}

impl From<&StepEvent> for MetricsLine {
    fn from(event: &StepEvent) -> Self {
        let finite = |value: f64| value.is_finite().then_some(value);
        Self {
            step: event.step,
            stage: event.stage,
            loss: finite(event.loss),
            psnr: finite(event.psnr),
            lr: finite(event.lr),
            grad_norm: finite(event.grad_norm),
            step_s: finite(event.step_s),
        }
    }
}

/// A file of JSON lines, one or none per step, each flushed: a killed run keeps all but the last.
#[derive(Debug)]
pub struct StepLines {
    path: PathBuf,
    /// Opened by the first line.
    file: Option<File>,
    failure: Option<std::io::Error>,
}

impl StepLines {
    /// Takes up the file of a run that goes on after `step` updates of `stage`; `0` for a stage that starts anew.
    ///
    /// Lines of later steps and stages are dropped, because they will be written again. So is a last line that was
    /// torn by a kill. The shortened file replaces the old one by a rename, never half of it.
    ///
    /// # Errors
    /// The operating system's, and `InvalidData` with the line's number for a line before the last that names no
    /// step: the file is then someone else's, and is left alone.
    pub fn open(path: &Path, stage: Stage, step: u64) -> std::io::Result<Self> {
        if path.exists() {
            truncate_after(path, stage, step)?;
        }
        Ok(Self { path: path.to_owned(), file: None, failure: None })
    }

    /// Appends a line. A failure is kept for [`StepLines::check`]; nothing is written after it.
    pub fn write(&mut self, line: &impl Serialize) {
        if self.failure.is_none() {
            self.failure = self.try_write(line).err();
        }
    }

    fn try_write(&mut self, line: &impl Serialize) -> std::io::Result<()> {
        let file = match &mut self.file {
            Some(file) => file,
            none => none.insert(OpenOptions::new().create(true).append(true).open(&self.path)?),
        };
        // One write a line: a kill tears at most the last one.
        file.write_all(format!("{}\n", serde_json::to_string(line)?).as_bytes())
    }

    /// Says whether every line was written, and makes them survive a power cut.
    ///
    /// # Errors
    /// The first failure to write; lines after it were not tried.
    pub fn check(&mut self) -> std::io::Result<()> {
        if let Some(failure) = self.failure.take() {
            return Err(failure);
        }
        self.file.as_ref().map_or(Ok(()), File::sync_data)
    }

    /// Where the lines go.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

/// What every line says about where it belongs.
#[derive(Deserialize)]
struct Place {
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
            let reason = format!("line {number} is not of a step");
            return Err(std::io::Error::new(std::io::ErrorKind::InvalidData, reason));
        }
        match serde_json::from_slice::<Place>(&line) {
            // Without its end a line may be torn, even if what is there can be read.
            Ok(place) if line.ends_with(b"\n") && (place.stage, place.step) <= (stage, step) => kept.extend(line),
            Ok(_) => is_whole = false,
            Err(_) => (is_whole, broken) = (false, Some(number)),
        }
    }
    if is_whole { Ok(()) } else { clift_data::replace_file(path, &kept) }
}

/// A scene that training drew and could not use: one line of `skipped.jsonl`, at the first draw.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SkipLine {
    /// Update it was drawn for.
    pub step: u64,
    /// Which stage.
    pub stage: Stage,
    /// The scene and why.
    #[serde(flatten)]
    pub skip: SkippedScene,
}

/// The files that a stage writes step by step, in front of another sink: a line per step in `metrics.jsonl`, one per
/// step left out in `bad_steps.jsonl`, and one per scene left out in `skipped.jsonl`.
pub struct RunLog<'a> {
    sink: &'a mut dyn Sink,
    metrics: StepLines,
    bad_steps: StepLines,
    skips: StepLines,
    /// Scenes that have a line.
    skipped: HashSet<String>,
}

impl<'a> RunLog<'a> {
    /// Takes up the files in `run_dir` after `step` updates of `stage`, as [`StepLines::open`].
    ///
    /// # Errors
    /// [`TrainError::Io`].
    pub fn open(run_dir: &Path, stage: Stage, step: u64, sink: &'a mut dyn Sink) -> Result<Self, TrainError> {
        let open = |name: &str| {
            let path = run_dir.join(name);
            StepLines::open(&path, stage, step).map_err(TrainError::io("opening the log of steps", &path))
        };
        let skips = open("skipped.jsonl")?;
        let skipped = read_skips(skips.path()).map_err(TrainError::io("reading the log of scenes", skips.path()))?;
        Ok(Self { sink, metrics: open("metrics.jsonl")?, bad_steps: open("bad_steps.jsonl")?, skips, skipped })
    }

    /// Tells and notes a scene that `step` could not use, once for all steps.
    pub fn skip(&mut self, stage: Stage, step: u64, skip: &SkippedScene) {
        if self.skipped.insert(skip.key.clone()) {
            self.sink.event(&Event::Skipped { key: skip.key.clone(), reason: skip.reason.clone() });
            self.skips.write(&SkipLine { step, stage, skip: skip.clone() });
        }
    }

    /// Notes a step that was left out.
    pub fn bad_step(&mut self, line: &SkippedStep) {
        self.bad_steps.write(line);
    }

    /// Says whether every line is on the disk. A checkpoint is only saved if so, or a resumed run would lack lines.
    ///
    /// # Errors
    /// [`TrainError::Io`] with the first failure.
    pub fn check(&mut self) -> Result<(), TrainError> {
        for lines in [&mut self.metrics, &mut self.bad_steps, &mut self.skips] {
            lines.check().map_err(TrainError::io("writing the log of steps", lines.path()))?;
        }
        Ok(())
    }
}

/// Keys of the scenes that have a line.
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
        if let Event::Step(step) = event {
            self.metrics.write(&MetricsLine::from(step));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn step(stage: Stage, step: u64) -> Event {
        let event =
            StepEvent { stage, step, num_steps: 9, loss: 0.5, psnr: 20.0, lr: 1e-3, grad_norm: 2.0, step_s: 0.25 };
        Event::Step(event)
    }

    /// Counts what it is told.
    #[derive(Default)]
    struct Count(usize);

    impl Sink for Count {
        fn event(&mut self, _event: &Event) {
            self.0 += 1;
        }
    }

    /// Writes to `metrics.jsonl` of a run.
    fn write(path: &Path, from: (Stage, u64), steps: &[(Stage, u64)]) {
        let mut count = Count::default();
        let mut log = RunLog::open(path.parent().unwrap(), from.0, from.1, &mut count).unwrap();
        for &(stage, number) in steps {
            log.event(&step(stage, number));
        }
        log.check().unwrap();
        assert_eq!(count.0, steps.len(), "the other sink is told too");
    }

    fn steps(path: &Path) -> Vec<(Stage, u64)> {
        let text = std::fs::read_to_string(path).unwrap();
        let lines = text.lines().map(|line| serde_json::from_str::<MetricsLine>(line).unwrap());
        lines.map(|line| (line.stage, line.step)).collect()
    }

    #[test]
    fn a_line_holds_the_documented_names_and_null_for_what_is_not_finite() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("metrics.jsonl");
        let mut count = Count::default();
        let mut sink = RunLog::open(folder.path(), Stage::Stage1, 0, &mut count).unwrap();
        sink.event(&Event::Message("not a step".into()));
        let Event::Step(event) = step(Stage::Stage1, 1) else { panic!() };
        sink.event(&Event::Step(StepEvent { psnr: f64::INFINITY, loss: f64::NAN, ..event }));
        assert_eq!(
            std::fs::read_to_string(&path).unwrap(), // before `check`: the line is flushed
            "{\"step\":1,\"stage\":\"stage1\",\"loss\":null,\"psnr\":null,\"lr\":0.001,\"grad_norm\":2.0,\"step_s\":0.25}\n"
        );
    }

    #[test]
    fn resuming_drops_the_lines_of_later_steps_and_stages() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("metrics.jsonl");
        let (one, two) = (Stage::Stage1, Stage::Stage2);
        write(&path, (one, 0), &[(one, 1), (one, 2), (one, 3), (two, 1), (two, 2)]);
        write(&path, (two, 1), &[(two, 2)]);
        assert_eq!(steps(&path), [(one, 1), (one, 2), (one, 3), (two, 1), (two, 2)]);
        write(&path, (one, 2), &[(one, 3)]);
        assert_eq!(steps(&path), [(one, 1), (one, 2), (one, 3)]);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_last_line_torn_by_a_kill_is_dropped() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("metrics.jsonl");
        write(&path, (Stage::Stage1, 0), &[(Stage::Stage1, 1)]);
        let whole_but_its_end = "{\"step\":2,\"stage\":\"stage1\"}";
        for torn in ["{\"step\":2,\"sta", "{\"step\":2,\"sta\n", "\u{0}\u{0}", whole_but_its_end] {
            let whole = std::fs::read_to_string(&path).unwrap();
            std::fs::write(&path, whole + torn).unwrap();
            write(&path, (Stage::Stage1, 5), &[]);
            assert_eq!(steps(&path), [(Stage::Stage1, 1)]);
        }
    }

    #[test]
    fn a_file_of_something_else_is_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("metrics.jsonl");
        std::fs::write(&path, "a diary\nof days\n").unwrap();
        let error = StepLines::open(&path, Stage::Stage1, 0).unwrap_err();
        assert_eq!(error.to_string(), "line 1 is not of a step");
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "a diary\nof days\n");
    }

    #[test]
    fn a_failure_to_write_is_told_once_and_ends_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("missing/metrics.jsonl");
        let mut lines = StepLines::open(&path, Stage::Stage1, 0).unwrap();
        lines.write(&1);
        std::fs::create_dir(folder.path().join("missing")).unwrap();
        lines.write(&2);
        assert!(!path.exists(), "a file with a gap would look whole");
        assert_eq!(lines.check().unwrap_err().kind(), std::io::ErrorKind::NotFound);
    }

    #[test]
    fn a_scene_that_is_left_out_is_told_and_saved_once_for_all_draws_and_resumptions() {
        let folder = tempfile::tempdir().unwrap();
        let skip = |key: &str, reason: &str| SkippedScene { key: key.into(), reason: reason.into() };
        let mut count = Count::default();
        let mut log = RunLog::open(folder.path(), Stage::Stage1, 0, &mut count).unwrap();
        log.skip(Stage::Stage1, 1, &skip("a", "torn"));
        log.skip(Stage::Stage1, 2, &skip("a", "torn at another frame"));
        log.skip(Stage::Stage1, 3, &skip("b", "torn"));
        log.check().unwrap();
        assert_eq!(count.0, 2);
        // From step 2 on: what step 3 said is said again.
        let mut log = RunLog::open(folder.path(), Stage::Stage1, 2, &mut count).unwrap();
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

    #[test]
    fn bad_steps_have_a_file_of_their_own_that_is_resumed_like_the_metrics() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("bad_steps.jsonl");
        let bad = |step| SkippedStep {
            step,
            stage: Stage::Stage1,
            reason: crate::step::step_guard::StepAnomaly::LossSpike,
            loss: Some(2.0),
            grad_norm: None,
            median_loss: Some(0.5),
            median_grad_norm: Some(1.0),
            in_a_row: 1,
            scenes: Vec::new(),
        };
        let mut count = Count::default();
        let mut log = RunLog::open(folder.path(), Stage::Stage1, 0, &mut count).unwrap();
        assert!(!path.exists(), "a run without bad steps has no such file");
        log.bad_step(&bad(3));
        log.bad_step(&bad(5));
        log.check().unwrap();
        RunLog::open(folder.path(), Stage::Stage1, 4, &mut count).unwrap();
        assert_eq!(
            std::fs::read_to_string(&path).unwrap(),
            "{\"step\":3,\"stage\":\"stage1\",\"reason\":\"loss_spike\",\"loss\":2.0,\"grad_norm\":null,\
             \"median_loss\":0.5,\"median_grad_norm\":1.0,\"in_a_row\":1,\"scenes\":[]}\n"
        );
    }
}
