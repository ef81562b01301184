//! What `clift encode` prints of a written scene.

use std::path::Path;

use clift_core::plural;
use clift_scene::{CheckedView, EncodedScene, MIN_CONTEXT_PSNR, WrittenScene};

use crate::output::stdout::{print_result, print_warning};
use crate::output::units::file_size;

/// Most frames of a list.
const MAX_LISTED: usize = 8;
/// Most held-out frames with a line of their own.
const MAX_LISTED_CHECKS: usize = 16;

/// Prints what was written, and how well its views come out. `model` is the name of the model; of a capture, warns of fog.
pub fn print_scene(written: &WrittenScene, out: &Path, model: &str, is_capture: bool) -> anyhow::Result<()> {
    print_result(&describe(written, out))?;
    let psnrs: Vec<f64> = written.contexts.iter().map(|view| view.psnr).collect();
    let psnr = clift_core::mean(&psnrs).unwrap_or_default();
    print_result(&format!("check: {} rendered at {psnr:.2} dB", plural(psnrs.len(), "context view")))?;
    let fog = written.contexts.iter().filter(|view| view.is_fog());
    let fog: Vec<String> = fog.map(|view| written.frame_name(view.frame)).collect();
    if is_capture && !fog.is_empty() {
        let more = if fog.len() > MAX_LISTED { ", .." } else { "" };
        print_warning(format!(
            "fog, below {MIN_CONTEXT_PSNR} dB or worse than the mean image, in {} of {} renderings of context views: {}{more}; \
             their neighbours are too far away: take more photos in between, encode one part of the place with --near PHOTO, \
             or train on the capture (configs/capture.toml)",
            fog.len(),
            psnrs.len(),
            fog[..fog.len().min(MAX_LISTED)].join(", ")
        ));
    }
    match written.others[..] {
        [] => Ok(()),
        [CheckedView { frame, psnr, baseline_psnr }] => {
            let frame = written.frame_name(frame);
            print_result(&format!(
                "check: frame {frame}, not a context: {psnr:.2} dB rendered, {baseline_psnr:.2} dB copied from the nearest \
                 context"
            ))?;
            if psnr < baseline_psnr {
                print_warning(format!(
                    "the rendering of frame {frame} is worse than a copy of the nearest context view; the scene differs \
                     from the training scenes of {model}, few tokens are stored, or the run is not trained enough"
                ));
            }
            Ok(())
        }
        ref views => {
            let mean = |value: fn(&CheckedView) -> f64| {
                clift_core::mean(&views.iter().map(value).collect::<Vec<_>>()).unwrap_or_default()
            };
            for view in views.iter().take(MAX_LISTED_CHECKS) {
                let name = written.frame_name(view.frame);
                print_result(&format!("  {name}: {:.2} dB, nearest context {:.2} dB", view.psnr, view.baseline_psnr))?;
            }
            print_result(&format!(
                "check: {} frames held out: {:.2} dB rendered, {:.2} dB copied from the nearest context; {} rendered better",
                views.len(),
                mean(|view| view.psnr),
                mean(|view| view.baseline_psnr),
                views.iter().filter(|view| view.psnr > view.baseline_psnr).count()
            ))
        }
    }
}

fn describe(written: &WrittenScene, path: &Path) -> String {
    let EncodedScene { scene, clusters, .. } = &written.encoded;
    let (num_tokens, num_lift_tokens) = (scene.num_tokens(), clusters.assignment().len());
    let mut frames: Vec<String> =
        scene.context_frames.iter().map(|&frame| written.frame_name(frame as usize)).collect();
    if frames.len() > MAX_LISTED {
        frames.splice(MAX_LISTED / 2..frames.len() - MAX_LISTED / 2, ["..".into()]);
    }
    let groups = match scene.groups.len() {
        1 => String::new(),
        count => format!(" in {count} groups"),
    };
    format!(
        "{}: {num_tokens} of {num_lift_tokens} tokens ({}, {}), {}\nscene {}, {}{groups} of {} x {}: frames {}",
        path.display(),
        scene.kind,
        written.stored,
        file_size(written.file_bytes),
        scene.key,
        match written.num_frames - scene.context.len() {
            0 => plural(scene.context.len(), "view"),
            _ => format!("{} of {}", scene.context.len(), plural(written.num_frames, "view")),
        },
        scene.width,
        scene.height,
        frames.join(", "),
    )
}
