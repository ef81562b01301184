//! Renders the frames of a path and writes them.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context;
use clift_data::{is_empty_folder, upper_median};
use clift_eval::{Animation, Canvas};
use clift_model::{SceneRenderer, ViewCamera};
use clift_train::TrainError;
use serde::Serialize;

use crate::exit_code::usage_bail;
use crate::output::counter::Counter;

/// Median seconds per frame.
#[derive(Debug, Serialize)]
pub struct Timing {
    pub select_s: f64,
    pub render_s: f64,
}

pub struct Frames {
    pub height: usize,
    pub width: usize,
    pub num_render_tokens: usize,
    pub fps: u16,
}

/// Checks that the output folder is empty or absent: frames of another path would mix with the new ones.
pub fn require_empty(out: &Path) -> anyhow::Result<()> {
    if is_empty_folder(out).with_context(|| format!("reading {}", out.display()))? {
        return Ok(());
    }
    usage_bail!("output folder {} is not empty; choose another folder or move it away", out.display())
}

/// Renders every view and writes the frames and the animation to `folder`, until `stop` is set.
pub fn write_frames(
    renderer: &mut SceneRenderer,
    views: &[ViewCamera],
    frames: &Frames,
    folder: &Path,
    stop: &AtomicBool,
) -> anyhow::Result<Timing> {
    let &Frames { height, width, num_render_tokens, fps } = frames;
    let mut animation = Animation::new(&folder.join("animation.png"), width, height, views.len(), fps)?;
    let mut counter = Counter::new("frames", views.len() as u64);
    let (mut select_s, mut render_s) = (Vec::new(), Vec::new());
    for some in views.chunks(renderer.frames_per_call(height, width)) {
        let first = render_s.len();
        if stop.load(Ordering::Relaxed) {
            let task = format!("rendering frame {first} of {}", views.len());
            return Err(TrainError::Abandoned { task }.into());
        }
        let results = renderer.render(some, height, width, num_render_tokens);
        for view in results.with_context(|| format!("rendering frames {first} to {}", first + some.len() - 1))? {
            let image = Canvas::from_unit(&view.pixels, height, width)?;
            image.write_png(&folder.join(format!("frame-{:05}.png", render_s.len())))?;
            animation.add(&image)?;
            select_s.push(view.select_s);
            render_s.push(view.render_s);
        }
        counter.set(render_s.len() as u64);
    }
    animation.finish()?;
    Ok(Timing { select_s: upper_median(&select_s), render_s: upper_median(&render_s) })
}
