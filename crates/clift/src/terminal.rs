//! Shows a run's events to people: a bar with rate and time left on a terminal, plain lines elsewhere.
//!
//! Both write to the standard error stream; the standard output is for results.

use std::io::{IsTerminal, Write};
use std::time::Duration;

use clift_train::events::{Event, Sink, Stage, StepEvent};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// Seconds of training between two plain lines of progress.
const PLAIN_INTERVAL_S: f64 = 10.0;

/// Chooses the sink that suits the standard error stream of this process.
pub fn sink() -> Box<dyn Sink> {
    if std::io::stderr().is_terminal() {
        Box::new(Bar::default())
    } else {
        Box::new(PlainLines::new(std::io::stderr()))
    }
}

/// A progress bar per stage, with lines above it for what happens once.
#[derive(Default)]
pub struct Bar {
    bar: Option<ProgressBar>,
}

impl Sink for Bar {
    fn event(&mut self, event: &Event) {
        if matches!(event, Event::StageStarted { .. } | Event::StageFinished { .. })
            && let Some(bar) = self.bar.take()
        {
            bar.finish_and_clear();
        }
        if let Some(line) = line(event) {
            match &self.bar {
                Some(bar) => bar.println(line),
                // Nowhere to show a failure to show something.
                None => drop(writeln!(std::io::stderr(), "{line}")),
            }
        }
        match (event, &self.bar) {
            (Event::StageStarted { stage, done, num_steps }, _) => {
                // Steps of an earlier process must not count for the rate: they pass unseen, and the clock starts then.
                let hidden = ProgressDrawTarget::hidden();
                let bar = ProgressBar::with_draw_target(Some(*num_steps as u64), hidden)
                    .with_style(style())
                    .with_prefix(stage.name());
                bar.update(|state| state.set_pos(*done as u64));
                bar.reset_eta();
                bar.set_draw_target(ProgressDrawTarget::stderr());
                bar.enable_steady_tick(Duration::from_millis(500));
                self.bar = Some(bar);
            }
            (Event::Step(step), Some(bar)) => {
                bar.set_message(numbers(step));
                bar.set_position(step.step as u64);
            }
            (Event::Progress { done, .. }, Some(bar)) => bar.set_position(*done as u64),
            _ => {}
        }
    }
}

const TEMPLATE: &str = "{prefix} {bar:24.cyan/dim} {pos}/{len}  {msg}  {per_sec}, {eta} left";

fn style() -> ProgressStyle {
    ProgressStyle::with_template(TEMPLATE).unwrap_or_else(|_| ProgressStyle::default_bar())
}

/// Lines for logs: what happens once at once, progress every ten seconds of training, the first and the last step.
pub struct PlainLines<W> {
    out: W,
    since_line_s: f64,
    /// Steps and seconds since the stage started or resumed.
    pace: (u64, f64),
    shown_tenth: u64,
}

impl<W: Write> PlainLines<W> {
    /// Writes to `out`.
    pub fn new(out: W) -> Self {
        Self { out, since_line_s: 0.0, pace: (0, 0.0), shown_tenth: 0 }
    }

    fn step_line(&mut self, event: &StepEvent) -> Option<String> {
        self.pace = (self.pace.0 + 1, self.pace.1 + event.step_s);
        self.since_line_s += event.step_s;
        let is_due = self.pace.0 == 1 || event.step == event.num_steps || self.since_line_s >= PLAIN_INTERVAL_S;
        if !is_due {
            return None;
        }
        self.since_line_s = 0.0;
        let mean_step_s = self.pace.1 / self.pace.0 as f64;
        let left = duration(mean_step_s * event.num_steps.saturating_sub(event.step) as f64);
        let (name, step, num_steps) = (event.stage.name(), event.step, event.num_steps);
        let width = num_steps.to_string().len();
        Some(format!("{name} {step:>width$}/{num_steps}  {}  {mean_step_s:.3} s/step, {left} left", numbers(event)))
    }
}

impl<W: Write> Sink for PlainLines<W> {
    fn event(&mut self, event: &Event) {
        let line = match event {
            Event::Step(step) => self.step_line(step),
            Event::Progress { stage, done, total } => {
                let tenth = done * 10 / (*total).max(1);
                let line = (tenth > self.shown_tenth).then(|| format!("{} {done}/{total}", stage.name()));
                self.shown_tenth = self.shown_tenth.max(tenth);
                line
            }
            _ => line(event),
        };
        if matches!(event, Event::StageStarted { .. }) {
            (self.pace, self.since_line_s, self.shown_tenth) = ((0, 0.0), 0.0, 0);
        }
        if let Some(line) = line {
            drop(writeln!(self.out, "{line}")); // nowhere to show a failure to show something
        }
    }
}

fn numbers(step: &StepEvent) -> String {
    format!("loss {:.4}  {:.2} dB  lr {:.2e}", step.loss, step.psnr, step.lr)
}

/// The line for an event that happens once; `None` for progress.
fn line(event: &Event) -> Option<String> {
    let unit = |stage: Stage| if stage == Stage::Clusters { "scenes" } else { "steps" };
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
fn duration(seconds: f64) -> String {
    let total = seconds.max(0.0).round() as u64;
    match (total / 86_400, total / 3600 % 24, total / 60 % 60, total % 60) {
        (0, 0, 0, s) => format!("{s} s"),
        (0, 0, min, s) => format!("{min} min {s} s"),
        (0, h, min, _) => format!("{h} h {min} min"),
        (d, h, ..) => format!("{d} d {h} h"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn step(step: u64, step_s: f64) -> Event {
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

    fn shown(events: &[Event]) -> String {
        let mut sink = PlainLines::new(Vec::new());
        for event in events {
            sink.event(event);
        }
        String::from_utf8(sink.out).unwrap()
    }

    #[test]
    fn plain_lines_are_throttled_to_one_in_ten_seconds_of_training() {
        let mut events = vec![Event::StageStarted { stage: Stage::Stage1, done: 0, num_steps: 100 }];
        events.extend((1..=100).map(|number| step(number, 0.25)));
        events.push(Event::StageFinished { stage: Stage::Stage1, elapsed_s: 25.0 });
        let expected = "stage1: 100 steps
stage1   1/100  loss 0.0123  21.50 dB  lr 4.00e-4  0.250 s/step, 25 s left
stage1  41/100  loss 0.0123  21.50 dB  lr 4.00e-4  0.250 s/step, 15 s left
stage1  81/100  loss 0.0123  21.50 dB  lr 4.00e-4  0.250 s/step, 5 s left
stage1 100/100  loss 0.0123  21.50 dB  lr 4.00e-4  0.250 s/step, 0 s left
stage1: done in 25 s
";
        assert_eq!(shown(&events), expected);
    }

    #[test]
    fn what_happens_once_is_shown_at_once() {
        let events = [
            Event::StageStarted { stage: Stage::Stage2, done: 40, num_steps: 100 },
            Event::Evaluated { stage: Stage::Stage2, step: 50, psnr: 24.309, ssim: None, num_views: 12 },
            Event::Checkpoint { path: "runs/tiny/stage2/step-50".into() },
            Event::Skipped { key: "room".into(), reason: "3 frames".into() },
            Event::Warning("hot".into()),
        ];
        let expected = "stage2: resumed after 40 of 100 steps
stage2 step 50: 24.31 dB over 12 held-out views
saved runs/tiny/stage2/step-50
skipped room: 3 frames
warning: hot
";
        assert_eq!(shown(&events), expected);
    }

    #[test]
    fn clustering_is_shown_every_tenth() {
        let events: Vec<_> = (1..=40).map(|done| Event::Progress { stage: Stage::Clusters, done, total: 40 }).collect();
        let text = shown(&events);
        assert_eq!(text.lines().count(), 10);
        assert!(text.starts_with("clusters 4/40\nclusters 8/40\n") && text.ends_with("clusters 40/40\n"));
    }

    #[test]
    fn a_duration_has_its_two_largest_units() {
        let shown = [0.4, 59.0, 61.0, 3600.0 * 7.75, 86_400.0 * 2.5].map(duration);
        assert_eq!(shown, ["0 s", "59 s", "1 min 1 s", "7 h 45 min", "2 d 12 h"]);
    }

    #[test]
    fn the_template_of_the_bar_is_valid_and_the_bar_follows_the_steps() {
        assert!(ProgressStyle::with_template(TEMPLATE).is_ok());
        let mut sink = Bar::default();
        sink.event(&Event::StageStarted { stage: Stage::Stage1, done: 40, num_steps: 100 });
        sink.event(&step(41, 0.1));
        assert_eq!(sink.bar.as_ref().map(ProgressBar::position), Some(41));
        sink.event(&Event::StageFinished { stage: Stage::Stage1, elapsed_s: 1.0 });
        assert!(sink.bar.is_none());
    }
}
