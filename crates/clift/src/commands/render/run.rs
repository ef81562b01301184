//! `clift render`.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clift_core::{Camera, StagedDir, interpolate_path, mean_intrinsics, orbit_path};
use clift_data::{plural, read_poses};
use clift_eval::available_bytes;
use clift_model::{DeviceName, ModelConfig, ModelError, ModelPath, PatchGrids, Precision, TokenCount};
use clift_scene::{MAX_SIDE_PX, RenderBudget, Scene, SceneRenderer, check_frames, frame_bytes, load_renderer};
use serde::Serialize;

use crate::commands::render::args::{CameraPath, RenderArgs};
use crate::commands::render::frames::{self, Frames, Rendered, Timing};
use crate::exit_code::usage_bail;
use crate::interrupt::{self, Ending};
use crate::output::output_file::OutputFile;
use crate::output::stdout::{print_note, print_result, print_warning};
use crate::output::units::file_size;

/// Frames of `--path interpolate` and `--path orbit` without `--frames`.
const DEFAULT_FRAMES: usize = 60;

/// Content of `render.json`.
#[derive(Debug, Serialize)]
struct Report {
    scene: String,
    path: String,
    /// Rule of token selection; `null` if every frame uses all tokens.
    selection: Option<&'static str>,
    /// Patch grids that each frame is the mean of.
    patch_grids: PatchGrids,
    device: &'static str,
    precision: Precision,
    height: usize,
    width: usize,
    num_frames: usize,
    num_storage_tokens: usize,
    num_render_tokens: usize,
    #[serde(flatten)]
    timing: Timing,
    /// Tokens of the scene file that each frame is rendered from; `null` if every frame uses all.
    tokens: Option<Vec<Vec<u32>>>,
    /// Token counts and their seconds per frame, measured for `--budget-ms`.
    calibration: Option<Vec<(usize, f64)>>,
}

pub fn run(args: &RenderArgs) -> anyhow::Result<()> {
    let (scene, _) = Scene::read_for(&args.scene, args.model.as_deref())?;
    let [width, height] = args.size.unwrap_or([scene.width, scene.height]);
    let device = args.device.unwrap_or_default();
    let patch_grids = args.patch_grids.unwrap_or(scene.model.patch_grids);
    let model = ModelConfig { patch_grids, ..scene.model.clone() };
    model.validate()?;
    check_size(&scene, &model, [width, height], device)?;
    if height > scene.height {
        print_warning(format!(
            "the network was trained on images of {} x {}; frames of {width} x {height} show no more detail",
            scene.width, scene.height
        ));
    }
    frames::check_out(&args.out, args.force)?;
    if let Some(video) = &args.video {
        OutputFile::new(video, args.force, &[&args.scene])?;
    }
    let views = path_cameras(&scene, args, height, width)?;
    check_frames(&scene, &views, [height, width])?;
    let weights = scene_weights(&scene, &args.scene, args.model.as_deref())?;
    let stop = interrupt::flag(Ending::WITHOUT_RESULTS)?;
    let opened = device.open()?;
    let precision = args.precision.unwrap_or_else(|| Precision::for_images(&opened));
    precision.check("--precision", &opened)?;
    let _precision = precision.scope();
    let network = load_renderer(&scene, &weights, &opened)?;
    let mut renderer = SceneRenderer::new(&scene, network, args.selection.rules(), &opened)?;
    renderer.set_patch_grids(patch_grids);
    let (num_render_tokens, calibration) = token_count(&scene, args, &mut renderer, &views[0], height, width)?;
    let creating = || format!("creating {}", args.out.display());
    let files = StagedDir::new(&args.out).with_context(creating)?;
    let frames = Frames { height, width, num_render_tokens, fps: args.fps, video: args.video.as_deref() };
    let Rendered { timing, tokens, has_video } =
        frames::write_frames(&mut renderer, &views, &frames, files.path(), &stop)?;
    let Timing { select_s, render_s } = timing;
    let report = Report {
        scene: scene.key.clone(),
        path: args.path.to_string(),
        selection: (num_render_tokens < renderer.max_render_tokens()).then(|| args.selection.name()),
        patch_grids,
        device: device.as_str(),
        precision,
        height,
        width,
        num_frames: views.len(),
        num_storage_tokens: scene.num_tokens(),
        num_render_tokens,
        timing,
        tokens,
        calibration: calibration.map(|times| times.some.into_iter().chain([times.all]).collect()),
    };
    OutputFile::new(&files.path().join(frames::REPORT), false, &[])?.write_json(&report)?;
    files.commit().with_context(creating)?;
    frames::remove_later_frames(&args.out, views.len()).with_context(creating)?;
    let video = args.video.as_ref().filter(|_| has_video);
    print_result(&format!(
        "{}: {} of {width} x {height}, each from {num_render_tokens} of {} tokens\n\
         {:.1} ms per frame on {device} in {precision} (median): {:.1} ms token selection, {:.1} ms rendering\n\
         animation, for a browser: {}{}",
        args.out.display(),
        plural(views.len(), "frame"),
        scene.num_tokens(),
        1e3 * (select_s + render_s),
        1e3 * select_s,
        1e3 * render_s,
        args.out.join(frames::ANIMATION).display(),
        video.map_or_else(String::new, |video| format!("\nvideo: {}", video.display())),
    ))
}

/// Returns the weight file of the scene that was read from `file`: that of `model`, or of the scene's own model.
pub fn scene_weights(scene: &Scene, file: &Path, model: Option<&Path>) -> anyhow::Result<PathBuf> {
    let path = model.map_or_else(|| scene.find_model(file), Path::to_path_buf);
    let weights = ModelPath::for_tokens(&path, scene.kind)?;
    if model.is_none() && !weights.exists() {
        // The path comes from an untrusted file: control characters must not reach the terminal.
        let path = weights.display().to_string();
        usage_bail!("the weights of the scene are not found at {}; set --model RUN", path.escape_debug());
    }
    Ok(weights)
}

/// Refuses sizes that exceed the limit of images or the available memory.
fn check_size(
    scene: &Scene,
    model: &ModelConfig,
    [width, height]: [usize; 2],
    device: DeviceName,
) -> anyhow::Result<()> {
    if width.max(height) > MAX_SIDE_PX {
        usage_bail!("--size {width}x{height}: write at most {MAX_SIDE_PX} pixels per side");
    }
    let needed = frame_bytes(scene, model, [height, width]);
    if let Some(available) = available_bytes(device).filter(|available| needed > *available) {
        let (needed, available) = (file_size(needed), file_size(available));
        usage_bail!(
            "frames of {width} x {height} need {needed} of memory, {available} are available; choose a smaller --size"
        );
    }
    Ok(())
}

/// Returns the number of tokens per frame, with the measurements if `--budget-ms` determines it.
fn token_count(
    scene: &Scene,
    args: &RenderArgs,
    renderer: &mut SceneRenderer,
    view: &Camera,
    height: usize,
    width: usize,
) -> anyhow::Result<(usize, Option<RenderBudget>)> {
    // A share is one of the tokens that a frame can be rendered from.
    let most = renderer.max_render_tokens();
    let Some(budget_ms) = args.budget_ms else {
        let count = match args.render {
            Some(TokenCount::Count(count)) => TokenCount::Count(count).of(scene.num_tokens())?.min(most),
            Some(share) => share.of(most)?,
            None => most,
        };
        return Ok((count, None));
    };
    let times = RenderBudget::measure(renderer, view, height, width)?;
    for (count, seconds) in times.some.iter().chain([&times.all]) {
        print_note(&format!("measured: {count} tokens, {:.1} ms per frame", 1e3 * seconds));
    }
    let Some(count) = times.most_tokens(budget_ms / 1e3) else {
        let least_ms = (1e4 * times.least_s()).ceil() / 10.0;
        let grids = args.patch_grids.unwrap_or(scene.model.patch_grids);
        let fewer = if grids == PatchGrids::One { "" } else { "write --patch-grids 1, " };
        usage_bail!(
            "the fastest frame takes {least_ms} ms on this device; {fewer}raise --budget-ms or choose a smaller --size"
        );
    };
    print_note(&format!("{budget_ms} ms per frame: {count} of {most} tokens"));
    Ok((count, Some(times)))
}

/// Returns the cameras of the path, with intrinsics in pixels of the frames.
fn path_cameras(scene: &Scene, args: &RenderArgs, height: usize, width: usize) -> anyhow::Result<Vec<Camera>> {
    let resized = |camera: &Camera| camera.resized([scene.height, scene.width], [height, width]);
    let context: Vec<Camera> = scene.context.iter().map(resized).collect();
    let views = match &args.path {
        CameraPath::Interpolate => interpolate_path(&context, args.frames.unwrap_or(DEFAULT_FRAMES)),
        CameraPath::Orbit => orbit_path(&context, args.frames.unwrap_or(DEFAULT_FRAMES)),
        CameraPath::File(file) => {
            if !file.exists() {
                usage_bail!("--path {}: no such file; write interpolate, orbit or a file of poses", file.display());
            }
            if file.is_dir() {
                usage_bail!("--path {}: a folder; write its transforms.json or a file of poses", file.display());
            }
            if args.frames.is_some() {
                usage_bail!("a file of poses determines the number of frames; remove --frames");
            }
            let default = mean_intrinsics(&context).context("the scene has no context views")?;
            read_poses(file, &scene.world, default, width, height)?
        }
    };
    if views.is_empty() {
        let fix = "write at least 1".into();
        return Err(ModelError::BadConfig { key: "frames", value: "0".into(), fix }.into());
    }
    Ok(views)
}
