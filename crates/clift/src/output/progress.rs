//! Progress of a run: a bar on a terminal, lines elsewhere.

use std::io::{Write, stderr};

use clift_core::plural;
use clift_train::{Event, RunStep, Sink, StepEvent};
use indicatif::ProgressBar;

use crate::output::counter::{bar, has_bar, scan_counter};
use crate::output::stdout::print_warning;
use crate::output::units::{duration, seconds};
use crate::output::visible::visible;
use crate::verbosity::Verbosity;

/// Seconds of training between two progress lines.
const INTERVAL_S: f64 = 10.0;

/// Creates the receiver of a run's events: a bar or progress lines; warnings alone for `--quiet`.
pub fn progress_sink() -> Box<dyn Sink> {
    match Verbosity::chosen() {
        Verbosity::Silent => return Box::new(|_: &Event| {}),
        Verbosity::Quiet => {
            return Box::new(|event: &Event| {
                if let Event::Warning(text) = event {
                    print_warning(text);
                }
            });
        }
        Verbosity::Normal => {}
    }
    let mut lines = ProgressLines::new(stderr(), has_bar());
    let mut scan = scan_counter();
    Box::new(move |event: &Event| match event {
        Event::Scan { done, total } => scan(*done, *total),
        _ => lines.event(event),
    })
}

/// Events at once; steps every ten seconds of training, and the first and the last one; beside a bar all.
struct ProgressLines<W> {
    out: W,
    has_bar: bool,
    /// The bar of a stage, below the lines.
    bar: Option<ProgressBar>,
    since_line_s: f64,
    /// Steps since the stage started or resumed, and the seconds of all but the first, which may compile kernels.
    pace: (u64, f64),
    printed_tenth: u64,
}

impl<W: Write> ProgressLines<W> {
    fn new(out: W, has_bar: bool) -> Self {
        Self { out, has_bar, bar: None, since_line_s: 0.0, pace: (0, 0.0), printed_tenth: 0 }
    }

    fn event(&mut self, event: &Event) {
        let line = match event {
            Event::Step(step) => self.step_line(step),
            Event::Progress { run_step, done, total } => {
                let tenth = done * 10 / (*total).max(1);
                let is_due = tenth > self.printed_tenth || self.bar.is_some();
                self.printed_tenth = self.printed_tenth.max(tenth);
                is_due.then(|| format!("{} {done}/{total}", run_step.name()))
            }
            _ => event_line(event),
        };
        if matches!(event, Event::StepStarted { .. }) {
            (self.pace, self.since_line_s, self.printed_tenth) = ((0, 0.0), 0.0, 0);
        }
        if matches!(event, Event::StepStarted { .. } | Event::StepFinished { .. })
            && let Some(bar) = self.bar.take()
        {
            bar.finish_and_clear();
        }
        match (line, &self.bar, event) {
            (None, ..) => {}
            (Some(line), Some(bar), Event::Step(StepEvent { step: done, .. }) | Event::Progress { done, .. }) => {
                bar.set_message(visible(&line).into_owned());
                bar.set_position(*done);
            }
            (Some(line), Some(bar), _) => bar.println(visible(&line)),
            // No other stream could report the failure.
            (Some(line), None, _) => drop(writeln!(self.out, "{}", visible(&line))),
        }
        if let (true, Event::StepStarted { done, num_steps, .. }) = (self.has_bar, event) {
            self.bar = Some(bar(*num_steps).with_position(*done));
        }
    }

    fn step_line(&mut self, event: &StepEvent) -> Option<String> {
        self.pace.0 += 1;
        if self.pace.0 > 1 {
            self.pace.1 += event.step_s;
        }
        self.since_line_s += event.step_s;
        let is_end = self.pace.0 == 1 || event.step == event.last_step;
        let is_due = is_end || self.has_bar || self.since_line_s >= INTERVAL_S;
        if !is_due {
            return None;
        }
        self.since_line_s = 0.0;
        let StepEvent { step, last_step, step_s, images_per_s, loss, psnr, .. } = *event;
        let mean_step_s = if self.pace.0 > 1 { self.pace.1 / (self.pace.0 - 1) as f64 } else { step_s };
        // Of the same steps as the time left, with two significant digits or more.
        let rate = images_per_s * step_s / mean_step_s.max(1e-9);
        let decimals = if rate >= 10.0 { 0 } else { 1 + usize::from(rate < 1.0) };
        let rate = if self.has_bar { String::new() } else { format!("  {rate:.decimals$} img/s") };
        let left = duration(mean_step_s * last_step.saturating_sub(step) as f64);
        let left = if self.pace.0 > 1 { format!("  {left} left") } else { String::new() };
        // At most 80 columns with the bar or the rate, up to steps of five digits.
        let (name, width) = (event.stage.name(), last_step.to_string().len());
        Some(format!("{name} {step:>width$}/{last_step}  loss {loss:.4}  {psnr:.2} dB{rate}{left}"))
    }
}

fn event_line(event: &Event) -> Option<String> {
    let unit = |run_step: &RunStep| match run_step {
        RunStep::Train(_) => "step",
        RunStep::Clusters => "context set",
        RunStep::Eval => "scene",
    };
    Some(match event {
        Event::Step(_) | Event::Progress { .. } | Event::Scan { .. } => return None,
        Event::StepStarted { run_step, done: 0, num_steps } => {
            format!("{}: {}", run_step.name(), plural(*num_steps as usize, unit(run_step)))
        }
        Event::StepStarted { run_step, done, num_steps } => {
            format!("{}: resumed after {done} of {}", run_step.name(), plural(*num_steps as usize, unit(run_step)))
        }
        Event::Pace { stage, step_s, .. } => format!("{}: {} per step", stage.name(), seconds(*step_s)),
        Event::StepFinished { run_step, elapsed_s } => format!("{}: done in {}", run_step.name(), duration(*elapsed_s)),
        Event::Evaluated { stage, step, psnr, ssim, num_views } => {
            let ssim = ssim.map(|ssim| format!(", SSIM {ssim:.3}")).unwrap_or_default();
            let views = plural(*num_views, "validation view");
            format!("{} step {step}: {psnr:.2} dB{ssim} over {views}", stage.name())
        }
        Event::Checkpoint { path } => format!("saved {}", path.display()),
        Event::Skipped { key, reason } => format!("skipped {key}: {reason}"),
        Event::Warning(text) => format!("warning: {text}"),
        Event::Message(text) => text.clone(),
    })
}

#[cfg(test)]
mod tests {
    use clift_train::Stage;

    use super::*;

    /// An update of stage 1, of 0.25 s.
    fn step(step: u64) -> StepEvent {
        StepEvent {
            stage: Stage::Stage1,
            step,
            last_step: 100,
            loss: 0.0123,
            psnr: 21.5,
            lr: 4e-4,
            grad_norm: 1.0,
            step_s: 0.25,
            images_per_s: 48.0,
            peak_bytes: None,
        }
    }

    fn printed(events: &[Event]) -> String {
        let mut lines = ProgressLines::new(Vec::new(), false);
        for event in events {
            lines.event(event);
        }
        String::from_utf8(lines.out).unwrap()
    }

    #[test]
    fn steps_print_one_line_per_ten_seconds() {
        let stage = Stage::Stage1;
        let mut events = vec![Event::StepStarted { run_step: stage.into(), done: 0, num_steps: 100 }];
        events.extend((1..=100).map(|number| Event::Step(step(number))));
        events.push(Event::StepFinished { run_step: stage.into(), elapsed_s: 25.0 });
        let expected = "stage1: 100 steps
stage1   1/100  loss 0.0123  21.50 dB  48 img/s
stage1  41/100  loss 0.0123  21.50 dB  48 img/s  15 s left
stage1  81/100  loss 0.0123  21.50 dB  48 img/s  5 s left
stage1 100/100  loss 0.0123  21.50 dB  48 img/s  0 s left
stage1: done in 25 s
";
        assert_eq!(printed(&events), expected);
    }

    #[test]
    fn a_bar_follows_the_steps_of_a_stage() {
        let mut lines = ProgressLines::new(Vec::new(), true);
        lines.event(&Event::StepStarted { run_step: Stage::Stage1.into(), done: 40, num_steps: 100 });
        let first = StepEvent { step_s: 12.34, last_step: 90_000, ..step(12_345) };
        lines.event(&Event::Step(first));
        lines.event(&Event::Step(StepEvent { step: 12_346, ..first }));
        let bar = lines.bar.as_ref().expect("a bar");
        assert_eq!(bar.message(), "stage1 12346/90000  loss 0.0123  21.50 dB  11 d 2 h left");
        assert!(bar.position() == 12_346 && bar.message().len() <= 80 - 9, "beside the bar of eight columns");
        lines.event(&Event::StepFinished { run_step: Stage::Stage1.into(), elapsed_s: 1.0 });
        assert!(lines.bar.is_none());
    }

    #[test]
    fn progress_prints_every_tenth() {
        let progress = |done| Event::Progress { run_step: RunStep::Clusters, done, total: 40 };
        let text = printed(&(1..=40).map(progress).collect::<Vec<_>>());
        assert_eq!(text.lines().count(), 10);
        assert!(text.starts_with("clusters 4/40\nclusters 8/40\n") && text.ends_with("clusters 40/40\n"));
    }
}
