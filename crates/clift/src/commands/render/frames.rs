//! The frames of a path, on disk.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context;
use clift_data::{is_empty_folder, upper_median};
use clift_eval::{Animation, Canvas};
use clift_model::{SceneRenderer, ViewCamera};
use clift_train::TrainError;

use crate::exit_code::UsageError;
use crate::output::counter::Counter;

/// Median seconds per frame.
pub struct Timing {
    pub select_s: f64,
    pub render_s: f64,
}

/// What is drawn of every view.
pub struct Frames {
    pub height: usize,
    pub width: usize,
    pub num_render_tokens: usize,
    /// Per second of the animation.
    pub fps: u16,
}

/// Frames of a former path would mix with those of this one.
pub fn refuse_existing(out: &Path) -> anyhow::Result<()> {
    if is_empty_folder(out).with_context(|| format!("reading {}", out.display()))? {
        return Ok(());
    }
    let message = "is not empty, and nothing is written over; choose another folder or move it away";
    Err(UsageError(format!("{} {message}", out.display())).into())
}

/// Draws every view and writes the frames to `folder`, one by one and as an animation, until `stop` is set.
pub fn write_frames(
    viewer: &mut SceneRenderer,
    views: &[ViewCamera],
    frames: &Frames,
    folder: &Path,
    stop: &AtomicBool,
) -> anyhow::Result<Timing> {
    let &Frames { height, width, num_render_tokens, fps } = frames;
    let mut animation = Animation::new(&folder.join("animation.png"), width, height, views.len(), fps)?;
    let mut counter = Counter::new("frames", views.len() as u64);
    let (mut select_s, mut render_s) = (Vec::new(), Vec::new());
    for some in views.chunks(viewer.frames_per_call(height, width)) {
        let first = render_s.len();
        if stop.load(Ordering::Relaxed) {
            let work = format!("frame {first} of {}", views.len());
            return Err(TrainError::Abandoned { work }.into());
        }
        let drawn = viewer.render(some, height, width, num_render_tokens);
        for drawn in drawn.with_context(|| format!("drawing frames {first} to {}", first + some.len() - 1))? {
            let picture = Canvas::from_unit(&drawn.pixels, height, width)?;
            picture.write_png(&folder.join(format!("frame-{:05}.png", render_s.len())))?;
            animation.add(&picture)?;
            select_s.push(drawn.select_s);
            render_s.push(drawn.render_s);
        }
        counter.set(render_s.len() as u64);
    }
    animation.finish()?;
    Ok(Timing { select_s: upper_median(&select_s), render_s: upper_median(&render_s) })
}
