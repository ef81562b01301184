//! Progress as lines for log files.

use std::io::Write;

use clift_train::{Event, Sink, StepEvent};

use crate::output::event_line::{event_line, image_rate, step_metrics, time_left};
use crate::output::visible::visible;

/// Seconds of training between two progress lines, unless every step is wanted.
pub const INTERVAL_S: f64 = 10.0;

/// Lines for log files: events at once; steps every `interval_s` seconds of training, and the first and the last one.
pub struct PlainLines<W> {
    out: W,
    since_line_s: f64,
    /// Steps since the stage started or resumed, and the seconds of all but the first, which may compile kernels.
    pace: (u64, f64),
    printed_tenth: u64,
    /// Seconds of training between two lines.
    interval_s: f64,
}

impl<W: Write> PlainLines<W> {
    pub fn new(out: W, interval_s: f64) -> Self {
        Self { out, since_line_s: 0.0, pace: (0, 0.0), printed_tenth: 0, interval_s }
    }

    fn step_line(&mut self, event: &StepEvent) -> Option<String> {
        self.pace.0 += 1;
        if self.pace.0 > 1 {
            self.pace.1 += event.step_s;
        }
        self.since_line_s += event.step_s;
        let is_due = self.pace.0 == 1 || event.step == event.last_step || self.since_line_s >= self.interval_s;
        if !is_due {
            return None;
        }
        self.since_line_s = 0.0;
        let StepEvent { step, last_step, last_step_of_size, step_s, images_per_s, .. } = *event;
        let mean_step_s = if self.pace.0 > 1 { self.pace.1 / (self.pace.0 - 1) as f64 } else { step_s };
        // Of the same steps as the time left.
        let rate = image_rate(images_per_s * step_s / mean_step_s.max(1e-9));
        let seconds = mean_step_s * last_step_of_size.saturating_sub(step) as f64;
        let left = time_left(seconds, last_step_of_size, last_step);
        let left = if self.pace.0 > 1 { format!("  {left}") } else { String::new() };
        // At most 80 columns, up to steps of five digits.
        let (name, width) = (event.stage.name(), last_step.to_string().len());
        Some(format!("{name} {step:>width$}/{last_step}  {}  {rate}{left}", step_metrics(event)))
    }
}

impl<W: Write> Sink for PlainLines<W> {
    fn event(&mut self, event: &Event) {
        let line = match event {
            Event::Step(step) => self.step_line(step),
            Event::Progress { run_step, done, total } => {
                let tenth = done * 10 / (*total).max(1);
                let line = (tenth > self.printed_tenth).then(|| format!("{} {done}/{total}", run_step.name()));
                self.printed_tenth = self.printed_tenth.max(tenth);
                line
            }
            _ => event_line(event),
        };
        if matches!(event, Event::StepStarted { .. } | Event::ImageSize { .. }) {
            (self.pace, self.since_line_s, self.printed_tenth) = ((0, 0.0), 0.0, 0);
        }
        if let Some(line) = line {
            drop(writeln!(self.out, "{}", visible(&line))); // no other stream could report the failure
        }
    }
}

#[cfg(test)]
mod tests {
    use clift_train::{RunStep, Stage};

    use super::*;
    use crate::output::event_line::tests::step;

    fn printed(events: &[Event]) -> String {
        let mut sink = PlainLines::new(Vec::new(), INTERVAL_S);
        for event in events {
            sink.event(event);
        }
        String::from_utf8(sink.out).unwrap()
    }

    #[test]
    fn steps_print_one_line_per_ten_seconds() {
        let mut events = vec![Event::StepStarted { run_step: Stage::Stage1.into(), done: 0, num_steps: 100 }];
        events.extend((1..=100).map(|number| step(number, 0.25)));
        events.push(Event::StepFinished { run_step: Stage::Stage1.into(), elapsed_s: 25.0 });
        events.insert(
            1,
            Event::ImageSize { stage: Stage::Stage1, size: [32, 16], done: 0, last_step_of_size: 60, last_step: 100 },
        );
        // The steps to come have larger images and another pace.
        let expected = "stage1: 100 steps
stage1: images of 32 x 16 pixels to step 60
stage1   1/100  loss 0.0123  21.50 dB  48 img/s
stage1  41/100  loss 0.0123  21.50 dB  48 img/s  5 s to 60
stage1  81/100  loss 0.0123  21.50 dB  48 img/s  5 s left
stage1 100/100  loss 0.0123  21.50 dB  48 img/s  0 s left
stage1: done in 25 s
";
        assert_eq!(printed(&events), expected);
    }

    #[test]
    fn lines_fit_a_terminal() {
        let Event::Step(first) = step(12_345, 12.34) else { unreachable!() };
        let first = StepEvent { last_step: 90_000, last_step_of_size: 45_000, images_per_s: 0.85, ..first };
        let text = printed(&[Event::Step(first), Event::Step(StepEvent { step: 12_346, ..first })]);
        assert!(text.ends_with("stage1 12346/90000  loss 0.0123  21.50 dB  0.85 img/s  4 d 15 h to 45000\n"), "{text}");
        assert!(text.lines().all(|line| line.len() <= 80), "{text}");
    }

    #[test]
    fn events_are_printed_at_once() {
        let events = [
            Event::StepStarted { run_step: Stage::Stage2.into(), done: 40, num_steps: 100 },
            Event::Evaluated { stage: Stage::Stage2, step: 50, psnr: 24.309, ssim: None, num_views: 12 },
            Event::Pace {
                stage: Stage::Stage2,
                step: 20,
                last_step_of_size: 100,
                last_step: 100,
                step_s: 0.75,
                peak_bytes: Some(3 << 29),
            },
            Event::Checkpoint { path: "runs/tiny/stage2/step-50".into() },
            Event::Skipped { key: "room".into(), reason: "3 frames".into() },
            Event::Warning("hot".into()),
            Event::StepStarted { run_step: RunStep::Eval, done: 0, num_steps: 7 },
        ];
        let expected = "stage2: resumed after 40 of 100 steps
stage2 step 50: 24.31 dB over 12 validation views
stage2: 750 ms per step, 1 min 0 s left, peak memory so far: 1.50 GiB
saved runs/tiny/stage2/step-50
skipped room: 3 frames
warning: hot
eval: 7 scenes
";
        assert_eq!(printed(&events), expected);
    }

    #[test]
    fn progress_prints_every_tenth() {
        let events: Vec<_> =
            (1..=40).map(|done| Event::Progress { run_step: RunStep::Clusters, done, total: 40 }).collect();
        let text = printed(&events);
        assert_eq!(text.lines().count(), 10);
        assert!(text.starts_with("clusters 4/40\nclusters 8/40\n") && text.ends_with("clusters 40/40\n"));
    }
}
