//! A progress bar on a terminal.

use std::time::Duration;

use clift_train::{Event, Sink};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressState, ProgressStyle};

use crate::output::event_line::{event_line, image_rate, step_metrics, time_left};
use crate::output::stdout::print_note;
use crate::output::units::rate;
use crate::output::visible::visible;

/// A progress bar per stage, with the lines of other events above the bar.
#[derive(Default)]
pub struct Bar {
    bar: Option<ProgressBar>,
    /// Whether the bar has shown no step.
    is_new: bool,
}

impl Sink for Bar {
    fn event(&mut self, event: &Event) {
        if matches!(event, Event::StepStarted { .. } | Event::ImageSize { .. } | Event::StepFinished { .. })
            && let Some(bar) = self.bar.take()
        {
            bar.finish_and_clear();
        }
        if let Some(line) = event_line(event) {
            match &self.bar {
                Some(bar) => bar.println(visible(&line)),
                None => print_note(&line),
            }
        }
        self.is_new |= matches!(event, Event::StepStarted { .. } | Event::ImageSize { .. });
        match (event, &self.bar) {
            (Event::StepStarted { run_step, done, num_steps }, _) => {
                self.bar = Some(progress_bar(run_step.name(), *done, *num_steps));
            }
            // Steps with images of another size take another time.
            (Event::ImageSize { stage, done, last_step_of_size, last_step, .. }, _) => {
                self.bar = Some(progress_bar_to(*last_step_of_size, stage.name(), *done, *last_step));
            }
            (Event::Step(step), Some(bar)) => {
                // The first step may compile kernels: its time is no pace.
                bar.set_message(format!("{}  {}", step_metrics(step), image_rate(step.images_per_s)));
                bar.set_position(step.step);
                if std::mem::take(&mut self.is_new) {
                    bar.reset_eta();
                }
            }
            (Event::Progress { done, .. }, Some(bar)) => bar.set_position(*done),
            _ => {}
        }
    }
}

// Everything up to the loss fits 80 columns. The message is cut at the end of the line: a wrapped bar would leave copies of
// itself behind.
const TEMPLATE: &str = "{prefix} {bar:8.cyan/dim} {pos}/{len}{pace}  {wide_msg}";

pub(crate) fn progress_bar(name: &str, done: u64, total: u64) -> ProgressBar {
    progress_bar_to(total, name, done, total)
}

/// Creates a progress bar that shows the time to `step` of `total`, up to which the pace holds.
fn progress_bar_to(step: u64, name: &str, done: u64, total: u64) -> ProgressBar {
    // Steps of an earlier process must not count for the rate: the position is set before the clock starts.
    let hidden = ProgressDrawTarget::hidden();
    let bar = ProgressBar::with_draw_target(Some(total), hidden).with_style(style(step)).with_prefix(name.to_owned());
    bar.update(|state| state.set_pos(done));
    bar.reset_eta();
    bar.set_draw_target(ProgressDrawTarget::stderr());
    bar.enable_steady_tick(Duration::from_millis(500));
    bar
}

fn style(step: u64) -> ProgressStyle {
    let pace = move |state: &ProgressState, out: &mut dyn std::fmt::Write| {
        let (at, total) = (state.pos(), state.len().unwrap_or_default());
        // A failed write only shortens the line.
        let _ = out.write_str(&pace(state.per_sec(), at, step, total));
    };
    ProgressStyle::with_template(TEMPLATE).unwrap_or_else(|_| ProgressStyle::default_bar()).with_key("pace", pace)
}

/// Formats the rate and the time from `at` to `step` of `total`; empty while the rate is unknown.
fn pace(per_s: f64, at: u64, step: u64, total: u64) -> String {
    if per_s > 0.0 {
        format!("  {}, {}", rate(per_s), time_left(step.saturating_sub(at) as f64 / per_s, step, total))
    } else {
        String::new()
    }
}

#[cfg(test)]
mod tests {
    use clift_train::Stage;

    use super::*;
    use crate::output::event_line::tests::step;

    #[test]
    fn bar_follows_steps_and_template_is_valid() {
        assert!(ProgressStyle::with_template(TEMPLATE).is_ok());
        let mut sink = Bar::default();
        sink.event(&Event::StepStarted { run_step: Stage::Stage1.into(), done: 40, num_steps: 100 });
        sink.event(&step(41, 0.1));
        assert_eq!(sink.bar.as_ref().map(ProgressBar::position), Some(41));
        let size = [32, 16];
        sink.event(&Event::ImageSize { stage: Stage::Stage1, size, done: 41, last_step_of_size: 60, last_step: 100 });
        let state = |bar: &ProgressBar| (bar.position(), bar.length());
        assert_eq!(sink.bar.as_ref().map(state), Some((41, Some(100))));
        sink.event(&Event::StepFinished { run_step: Stage::Stage1.into(), elapsed_s: 1.0 });
        assert!(sink.bar.is_none());
    }

    #[test]
    fn no_time_left_before_the_first_step() {
        assert_eq!(pace(0.0, 0, 60, 100), "");
        assert_eq!(pace(0.125, 50, 60, 60), "  8.0 s each, 1 min 20 s left");
        assert_eq!(pace(0.125, 50, 60, 100), "  8.0 s each, 1 min 20 s to 60");
    }
}
