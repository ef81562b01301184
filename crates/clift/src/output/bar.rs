//! A progress bar on a terminal.

use std::time::Duration;

use clift_train::{Event, Sink};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressState, ProgressStyle};

use crate::output::event_line::{duration, line, numbers, rate};
use crate::output::stdout::print_note;

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
                None => print_note(&line),
            }
        }
        match (event, &self.bar) {
            (Event::StageStarted { stage, done, num_steps }, _) => {
                self.bar = Some(progress_bar(stage.name(), *done, *num_steps));
            }
            (Event::Step(step), Some(bar)) => {
                bar.set_message(numbers(step));
                bar.set_position(step.step);
            }
            (Event::Progress { done, .. }, Some(bar)) => bar.set_position(*done),
            _ => {}
        }
    }
}

// Everything up to the message fits 80 columns; the message is cut where the line ends, so that it never wraps.
const TEMPLATE: &str = "{prefix} {bar:16.cyan/dim} {pos}/{len}{pace}  {wide_msg}";

/// A bar on the standard error stream that has `done` of `total` behind it.
pub(crate) fn progress_bar(name: &str, done: u64, total: u64) -> ProgressBar {
    // Steps of an earlier process must not count for the rate: they pass unseen, and the clock starts then.
    let hidden = ProgressDrawTarget::hidden();
    let bar = ProgressBar::with_draw_target(Some(total), hidden).with_style(style()).with_prefix(name.to_owned());
    bar.update(|state| state.set_pos(done));
    bar.reset_eta();
    bar.set_draw_target(ProgressDrawTarget::stderr());
    bar.enable_steady_tick(Duration::from_millis(500));
    bar
}

fn style() -> ProgressStyle {
    let pace = |state: &ProgressState, out: &mut dyn std::fmt::Write| {
        // A failed write shortens the line, which is all there is to it.
        let _ = out.write_str(&pace(state.per_sec(), state.eta()));
    };
    ProgressStyle::with_template(TEMPLATE).unwrap_or_else(|_| ProgressStyle::default_bar()).with_key("pace", pace)
}

/// Rate and time left; nothing while the rate is unknown.
fn pace(per_s: f64, left: Duration) -> String {
    if per_s > 0.0 { format!("  {}, {} left", rate(per_s), duration(left.as_secs_f64())) } else { String::new() }
}

#[cfg(test)]
mod tests {
    use clift_train::Stage;

    use super::*;
    use crate::output::event_line::tests::step;

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

    #[test]
    fn a_bar_shows_no_time_left_before_the_first_step() {
        assert_eq!(pace(0.0, Duration::ZERO), "");
        assert_eq!(pace(0.125, Duration::from_secs(80)), "  8.0 s each, 1 min 20 s left");
    }
}
