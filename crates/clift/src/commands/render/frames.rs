//! Renders the frames of a path and writes them.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context;
use clift_core::{Camera, is_empty_folder, median};
use clift_eval::{Animation, Canvas, Video};
use clift_scene::SceneRenderer;
use clift_train::TrainError;
use serde::Serialize;

use crate::exit_code::usage_bail;
use crate::output::counter::Counter;
use crate::output::stdout::print_warning;

/// Median seconds per frame.
#[derive(Debug, Serialize)]
pub struct Timing {
    pub select_s: f64,
    pub render_s: f64,
}

/// Times and tokens of the rendered frames.
pub struct Rendered {
    /// Median seconds.
    pub timing: Timing,
    /// Indices of the tokens of each frame, ascending; `None` if every frame uses all tokens.
    pub tokens: Option<Vec<Vec<u32>>>,
    /// Whether the video was written.
    pub has_video: bool,
}

/// Settings of all frames.
pub struct Frames<'a> {
    pub height: usize,
    pub width: usize,
    pub num_render_tokens: usize,
    pub fps: u16,
    /// MP4 to write beside the frames.
    pub video: Option<&'a Path>,
}

/// File of the animation.
pub const ANIMATION: &str = "animation.png";

/// File of the path, token counts and times of the frames.
pub const REPORT: &str = "render.json";

/// Checks that the output folder is empty or absent, or holds frames that `replace` allows to replace.
pub fn check_out(out: &Path, replace: bool) -> anyhow::Result<()> {
    if out.is_file() {
        usage_bail!("output folder {}: that is a file; write the name of a folder", out.display());
    }
    if is_empty_folder(out).with_context(|| format!("reading {}", out.display()))? {
        return Ok(());
    }
    let out_text = out.display();
    match (out.join(REPORT).is_file(), replace) {
        (true, true) => Ok(()),
        (true, false) => {
            usage_bail!("output folder {out_text} holds frames; replace them with --force or choose another")
        }
        (false, _) => usage_bail!("output folder {out_text} is not empty and holds no frames; choose another folder"),
    }
}

/// Removes the frames of a longer path that was replaced by one of `num_frames`.
pub fn remove_later_frames(out: &Path, num_frames: usize) -> std::io::Result<()> {
    for item in std::fs::read_dir(out)? {
        let item = item?;
        let name = item.file_name();
        let number = name.to_str().and_then(|name| name.strip_prefix("frame-")?.strip_suffix(".png")?.parse().ok());
        if number.is_some_and(|number: usize| number >= num_frames) {
            std::fs::remove_file(item.path())?;
        }
    }
    Ok(())
}

/// Renders every view and writes the frames and the animation to `folder`, until `stop` is set.
pub fn write_frames(
    renderer: &mut SceneRenderer,
    views: &[Camera],
    frames: &Frames<'_>,
    folder: &Path,
    stop: &AtomicBool,
) -> anyhow::Result<Rendered> {
    let &Frames { height, width, num_render_tokens, fps, video } = frames;
    let mut animation = Animation::new(&folder.join(ANIMATION), width, height, views.len(), fps)?;
    let mut writer = match video {
        Some(path) => Video::start(path, width, height, fps)?,
        None => None,
    };
    if video.is_some() && writer.is_none() {
        print_warning(format!("no `ffmpeg` on the PATH: no video is written, the animation is {ANIMATION}"));
    }
    let mut counter = Counter::new("frames", views.len() as u64);
    let (mut select_s, mut render_s, mut tokens) = (Vec::new(), Vec::new(), Vec::new());
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
            if let Some(video) = &mut writer {
                video.add(&image)?;
            }
            select_s.push(view.select_s);
            render_s.push(view.render_s);
            tokens.push(view.tokens);
        }
        counter.set(render_s.len() as u64);
    }
    animation.finish()?;
    let has_video = writer.is_some();
    if let Some(video) = writer {
        video.finish()?;
    }
    let timing = Timing { select_s: median(&select_s), render_s: median(&render_s) };
    Ok(Rendered { timing, tokens: tokens.into_iter().collect(), has_video })
}
