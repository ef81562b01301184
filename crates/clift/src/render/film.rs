//! The frames of a path, on disk.

use std::path::Path;

use anyhow::Context;
use clift_eval::Animation;
use clift_eval::picture::Picture;
use clift_model::viewer::FRAMES_PER_CALL;
use clift_model::{ViewCamera, Viewer};

use super::args::RenderArgs;
use crate::WrongUsage;
use crate::terminal::Counter;

/// Median seconds per frame.
pub struct Timing {
    pub select_s: f64,
    pub render_s: f64,
}

/// Frames of a former path would mix with those of this one.
pub fn refuse_existing(out: &Path) -> anyhow::Result<()> {
    let mut items = match std::fs::read_dir(out) {
        Ok(items) => items,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(()),
        Err(error) => return Err(error).with_context(|| format!("reading {}", out.display())),
    };
    if items.next().is_some() {
        let message = "is not empty, and nothing is written over; choose another folder or move it away";
        return Err(WrongUsage(format!("{} {message}", out.display())).into());
    }
    Ok(())
}

/// Draws every view and writes the frames, one by one and as an animation.
pub fn film(
    viewer: &mut Viewer,
    views: &[ViewCamera],
    [height, width]: [usize; 2],
    num_render_tokens: usize,
    args: &RenderArgs,
) -> anyhow::Result<Timing> {
    let out = &args.out;
    std::fs::create_dir_all(out).with_context(|| format!("making {}", out.display()))?;
    let mut animation = Animation::new(&out.join("animation.png"), width, height, views.len(), args.fps)?;
    let mut counter = Counter::new("frames", views.len() as u64);
    let (mut select_s, mut render_s) = (Vec::new(), Vec::new());
    for views in views.chunks(FRAMES_PER_CALL) {
        for drawn in viewer.draw(views, height, width, num_render_tokens)? {
            let picture = Picture::from_unit(&drawn.pixels, height, width)?;
            picture.write_png(&out.join(format!("frame-{:05}.png", render_s.len())))?;
            animation.add(&picture)?;
            select_s.push(drawn.select_s);
            render_s.push(drawn.render_s);
        }
        counter.set(render_s.len() as u64);
    }
    animation.finish()?;
    Ok(Timing { select_s: median(select_s), render_s: median(render_s) })
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or_default()
}
