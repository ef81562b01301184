//! Sinks without a terminal: `metrics.jsonl`, and one that feeds several others.

use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::events::{Event, Sink, Stage, StepEvent};

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

/// Writes a line per step to `metrics.jsonl`, flushed, so that a killed run keeps all but its last line.
#[derive(Debug)]
pub struct MetricsFile {
    path: PathBuf,
    file: File,
    failure: Option<std::io::Error>,
}

impl MetricsFile {
    /// Opens the file of a run that goes on after `step` updates of `stage`; `0` for a stage that starts anew.
    ///
    /// Lines of later steps and stages are dropped, because they will be written again. So is a last line that was
    /// torn by a kill. The shortened file replaces the old one by a rename, never half of it.
    ///
    /// # Errors
    /// The operating system's, and `InvalidData` with the line's number for a line before the last that is no
    /// metrics line: the file is then someone else's, and is left alone.
    pub fn open(path: &Path, stage: Stage, step: u64) -> std::io::Result<Self> {
        if path.exists() {
            drop_after(path, stage, step)?;
        }
        let file = OpenOptions::new().create(true).append(true).open(path)?;
        Ok(Self { path: path.to_owned(), file, failure: None })
    }

    /// Says whether every line reached the disk.
    ///
    /// # Errors
    /// The first failure to write; lines after it were not tried.
    pub fn finish(self) -> std::io::Result<()> {
        self.failure.map_or(Ok(()), Err)
    }

    /// Where the lines go.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

impl Sink for MetricsFile {
    fn event(&mut self, event: &Event) {
        let (Event::Step(step), None) = (event, &self.failure) else { return };
        let written = serde_json::to_string(&MetricsLine::from(step))
            .map_err(std::io::Error::from)
            // One write a line: a kill tears at most the last one.
            .and_then(|line| self.file.write_all(format!("{line}\n").as_bytes()))
            .and_then(|()| self.file.flush());
        self.failure = written.err();
    }
}

fn drop_after(path: &Path, stage: Stage, step: u64) -> std::io::Result<()> {
    let mut kept = Vec::new();
    let mut broken: Option<usize> = None;
    for (index, line) in BufReader::new(File::open(path)?).split(b'\n').enumerate() {
        let line = line?;
        if let Some(number) = broken {
            let reason = format!("line {number} is no line of metrics");
            return Err(std::io::Error::new(std::io::ErrorKind::InvalidData, reason));
        }
        match serde_json::from_slice::<MetricsLine>(&line) {
            Ok(metrics) if (metrics.stage, metrics.step) <= (stage, step) => {
                kept.extend(line);
                kept.push(b'\n');
            }
            Ok(_) => {}
            Err(_) => broken = Some(index + 1),
        }
    }
    clift_data::files::replace(path, &kept)
}

/// Gives every event to several sinks, in order.
#[derive(Default)]
pub struct Tee<'a> {
    sinks: Vec<&'a mut dyn Sink>,
}

impl<'a> Tee<'a> {
    /// Feeds these sinks.
    pub fn new(sinks: Vec<&'a mut dyn Sink>) -> Self {
        Self { sinks }
    }
}

impl Sink for Tee<'_> {
    fn event(&mut self, event: &Event) {
        for sink in &mut self.sinks {
            sink.event(event);
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

    fn write(path: &Path, from: (Stage, u64), steps: &[(Stage, u64)]) {
        let mut sink = MetricsFile::open(path, from.0, from.1).unwrap();
        for &(stage, number) in steps {
            sink.event(&step(stage, number));
        }
        sink.finish().unwrap();
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
        let mut sink = MetricsFile::open(&path, Stage::Stage1, 0).unwrap();
        sink.event(&Event::Message("not a step".into()));
        let Event::Step(event) = step(Stage::Stage1, 1) else { panic!() };
        sink.event(&Event::Step(StepEvent { psnr: f64::INFINITY, loss: f64::NAN, ..event }));
        assert_eq!(
            std::fs::read_to_string(&path).unwrap(), // before `finish`: the line is flushed
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
        for torn in ["{\"step\":2,\"sta", "{\"step\":2,\"sta\n", "\u{0}\u{0}"] {
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
        let error = MetricsFile::open(&path, Stage::Stage1, 0).unwrap_err();
        assert_eq!(error.to_string(), "line 1 is no line of metrics");
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "a diary\nof days\n");
    }

    #[test]
    fn a_tee_feeds_every_sink() {
        #[derive(Default)]
        struct Count(usize);
        impl Sink for Count {
            fn event(&mut self, _event: &Event) {
                self.0 += 1;
            }
        }
        let (mut a, mut b) = (Count::default(), Count::default());
        Tee::new(vec![&mut a, &mut b]).event(&Event::Warning("hot".into()));
        assert_eq!((a.0, b.0), (1, 1));
    }
}
