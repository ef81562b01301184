//! Events of a run as lines of text, for the bar and for log files.

use clift_train::{Event, Stage, StepEvent};

use crate::output::units::duration;

pub(crate) fn step_metrics(step: &StepEvent) -> String {
    format!("loss {:.4}  {:.2} dB  lr {:.2e}", step.loss, step.psnr, step.lr)
}

/// Formats the time to a step with the present pace: the last step, or the last one with images of the present size.
pub(crate) fn time_left(seconds: f64, last_step_of_size: u64, last_step: u64) -> String {
    let time = duration(seconds);
    if last_step_of_size < last_step { format!("{time} to step {last_step_of_size}") } else { format!("{time} left") }
}

pub(crate) fn event_line(event: &Event) -> Option<String> {
    let unit = |stage: Stage| match stage {
        Stage::Stage1 | Stage::Stage2 => "steps",
        Stage::Clusters => "context sets",
        Stage::Eval => "scenes",
    };
    Some(match event {
        Event::Scan { .. } | Event::Step(_) | Event::Progress { .. } => return None,
        Event::StageStarted { stage, done: 0, num_steps } => format!("{}: {num_steps} {}", stage.name(), unit(*stage)),
        Event::StageStarted { stage, done, num_steps } => {
            format!("{}: resumed after {done} of {num_steps} {}", stage.name(), unit(*stage))
        }
        Event::ImageSize { stage, size: [width, height], last_step_of_size: last_step, .. } => {
            format!("{}: images of {width} x {height} pixels to step {last_step}", stage.name())
        }
        Event::StageFinished { stage, elapsed_s } => format!("{}: done in {}", stage.name(), duration(*elapsed_s)),
        Event::Evaluated { stage, step, psnr, ssim, num_views } => {
            let ssim = ssim.map(|ssim| format!(", SSIM {ssim:.3}")).unwrap_or_default();
            format!("{} step {step}: {psnr:.2} dB{ssim} over {num_views} validation views", stage.name())
        }
        Event::Checkpoint { path } => format!("saved {}", path.display()),
        Event::Skipped { key, reason } => format!("skipped {key}: {reason}"),
        Event::Warning(text) => format!("warning: {text}"),
        Event::Message(text) => text.clone(),
    })
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// An update of stage 1.
    pub(crate) fn step(step: u64, step_s: f64) -> Event {
        let (stage, last_step, last_step_of_size) = (Stage::Stage1, 100, if step <= 60 { 60 } else { 100 });
        let (loss, psnr, lr, grad_norm) = (0.0123, 21.5, 4e-4, 1.0);
        Event::Step(StepEvent { stage, step, last_step, last_step_of_size, loss, psnr, lr, grad_norm, step_s })
    }
}
