//! Events of a run as lines of text, for the bar and for log files.

use clift_data::plural;
use clift_train::{Event, RunStep, StepEvent};

use crate::output::units::{duration, memory_size, seconds};

pub(crate) fn step_metrics(step: &StepEvent) -> String {
    format!("loss {:.4}  {:.2} dB", step.loss, step.psnr)
}

/// Formats images per second with two significant digits or more: `0.85 img/s`, `4.2 img/s`, `120 img/s`.
pub(crate) fn image_rate(per_s: f64) -> String {
    let decimals = if per_s >= 10.0 { 0 } else { 1 + usize::from(per_s < 1.0) };
    format!("{per_s:.decimals$} img/s")
}

/// Formats the time to a step with the present pace: the last step, or the last one with images of the present size.
pub(crate) fn time_left(seconds: f64, last_step_of_size: u64, last_step: u64) -> String {
    let time = duration(seconds);
    if last_step_of_size < last_step { format!("{time} to {last_step_of_size}") } else { format!("{time} left") }
}

pub(crate) fn event_line(event: &Event) -> Option<String> {
    let unit = |run_step: &RunStep| match run_step {
        RunStep::Train(_) => "step",
        RunStep::Clusters => "context set",
        RunStep::Eval => "scene",
    };
    Some(match event {
        Event::Scan { .. } | Event::Step(_) | Event::Progress { .. } => return None,
        Event::StepStarted { run_step, done: 0, num_steps } => {
            format!("{}: {}", run_step.name(), plural(*num_steps as usize, unit(run_step)))
        }
        Event::StepStarted { run_step, done, num_steps } => {
            format!("{}: resumed after {done} of {}", run_step.name(), plural(*num_steps as usize, unit(run_step)))
        }
        Event::ImageSize { stage, size: [width, height], last_step_of_size: last_step, .. } => {
            format!("{}: images of {width} x {height} pixels to step {last_step}", stage.name())
        }
        Event::Pace { stage, step, last_step_of_size, last_step, step_s, peak_bytes } => {
            let left_s = step_s * last_step_of_size.saturating_sub(*step) as f64;
            let left = time_left(left_s, *last_step_of_size, *last_step);
            let memory = peak_bytes.map_or_else(|| "unknown".into(), memory_size);
            format!("{}: {} per step, {left}, peak memory so far: {memory}", stage.name(), seconds(*step_s))
        }
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
pub(crate) mod tests {
    use clift_train::Stage;

    use super::*;

    /// An update of stage 1.
    pub(crate) fn step(step: u64, step_s: f64) -> Event {
        let (stage, last_step, last_step_of_size) = (Stage::Stage1, 100, if step <= 60 { 60 } else { 100 });
        let (loss, psnr, lr, grad_norm, images_per_s, peak_bytes) = (0.0123, 21.5, 4e-4, 1.0, 48.0, None);
        Event::Step(StepEvent {
            stage,
            step,
            last_step,
            last_step_of_size,
            loss,
            psnr,
            lr,
            grad_norm,
            step_s,
            images_per_s,
            peak_bytes,
        })
    }
}
