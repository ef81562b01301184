//! Shows what goes on to people: a bar with rate and time left on a terminal, plain lines elsewhere.
//!
//! Both write to the standard error stream; the standard output is for results.

use clift_train::{Event, Stage, StepEvent};

pub(crate) fn numbers(step: &StepEvent) -> String {
    format!("loss {:.4}  {:.2} dB  lr {:.2e}", step.loss, step.psnr, step.lr)
}

/// The line for an event that happens once; `None` for progress.
pub(crate) fn line(event: &Event) -> Option<String> {
    let unit = |stage: Stage| match stage {
        Stage::Stage1 | Stage::Stage2 => "steps",
        Stage::Clusters | Stage::Eval => "scenes",
    };
    Some(match event {
        Event::Step(_) | Event::Progress { .. } => return None,
        Event::StageStarted { stage, done: 0, num_steps } => format!("{}: {num_steps} {}", stage.name(), unit(*stage)),
        Event::StageStarted { stage, done, num_steps } => {
            format!("{}: resumed after {done} of {num_steps} {}", stage.name(), unit(*stage))
        }
        Event::StageFinished { stage, elapsed_s } => format!("{}: done in {}", stage.name(), duration(*elapsed_s)),
        Event::Evaluated { stage, step, psnr, ssim, num_views } => {
            let ssim = ssim.map(|ssim| format!(", SSIM {ssim:.3}")).unwrap_or_default();
            format!("{} step {step}: {psnr:.2} dB{ssim} over {num_views} held-out views", stage.name())
        }
        Event::Checkpoint { path } => format!("saved {}", path.display()),
        Event::Skipped { key, reason } => format!("skipped {key}: {reason}"),
        Event::Warning(text) => format!("warning: {text}"),
        Event::Message(text) => text.clone(),
    })
}

/// Writes a duration in its two largest units.
pub(crate) fn duration(seconds: f64) -> String {
    let total = seconds.max(0.0).round() as u64;
    match (total / 86_400, total / 3600 % 24, total / 60 % 60, total % 60) {
        (0, 0, 0, s) => format!("{s} s"),
        (0, 0, min, s) => format!("{min} min {s} s"),
        (0, h, min, _) => format!("{h} h {min} min"),
        (d, h, ..) => format!("{d} d {h} h"),
    }
}

/// Writes a rate, as the time of one where that is longer than a second.
pub(crate) fn rate(per_s: f64) -> String {
    if per_s >= 1.0 { format!("{per_s:.1}/s") } else { format!("{:.1} s each", 1.0 / per_s) }
}

#[cfg(test)]
pub(crate) mod tests {
    use std::io::{ErrorKind, Write};

    use super::*;
    use crate::output::stdout::write_result;

    /// An update of stage 1.
    pub(crate) fn step(step: u64, step_s: f64) -> Event {
        let stage = Stage::Stage1;
        Event::Step(StepEvent {
            stage,
            step,
            num_steps: 100,
            loss: 0.0123,
            psnr: 21.5,
            lr: 4e-4,
            grad_norm: 1.0,
            step_s,
        })
    }

    /// Fails to take what is buffered.
    struct Fails(ErrorKind);

    impl Write for Fails {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            Ok(bytes.len())
        }
        fn flush(&mut self) -> std::io::Result<()> {
            Err(self.0.into())
        }
    }

    #[test]
    fn a_reader_who_leaves_is_no_error_and_a_full_disk_is() {
        assert!(write_result(Fails(ErrorKind::BrokenPipe), "row").is_ok());
        let error = write_result(Fails(ErrorKind::StorageFull), "row").unwrap_err();
        assert_eq!(crate::exit_code::message(&error), "writing to the standard output: no storage space");
        assert_eq!(crate::exit_code::exit_code(&error), crate::exit_code::FAILED);
        let mut out = Vec::new();
        write_result(&mut out, "row").unwrap();
        assert_eq!(out, b"row\n");
    }

    #[test]
    fn a_duration_has_its_two_largest_units() {
        let shown = [0.4, 59.0, 61.0, 3600.0 * 7.75, 86_400.0 * 2.5].map(duration);
        assert_eq!(shown, ["0 s", "59 s", "1 min 1 s", "7 h 45 min", "2 d 12 h"]);
    }

    #[test]
    fn a_slow_rate_is_the_time_of_one() {
        assert_eq!([12.34, 1.0, 0.4].map(rate), ["12.3/s", "1.0/s", "2.5 s each"]);
    }

    #[test]
    fn stages_are_counted_in_what_they_work_off() {
        let started = |stage| line(&Event::StageStarted { stage, done: 0, num_steps: 7 });
        assert_eq!(started(Stage::Stage2).as_deref(), Some("stage2: 7 steps"));
        assert_eq!(started(Stage::Eval).as_deref(), Some("eval: 7 scenes"));
    }
}
