//! `clift render`.

use anyhow::Context;
use clift_data::{
    Intrinsics, PathView, Pose, PoseNormalization, StagedDir, interpolate_path, mean_intrinsics, orbit_path,
    read_poses, replace_file,
};
use clift_eval::available_bytes;
use clift_model::{
    DeviceName, MAX_SIDE_PX, ModelError, ModelPath, RenderBudget, Scene, SceneRenderer, ViewCamera, frames_per_call,
    load_renderer, render_bytes,
};
use serde::Serialize;

use crate::commands::data::text::bytes;
use crate::commands::render::args::{CameraPath, RenderArgs};
use crate::commands::render::frames::{self, Frames};
use crate::exit_code::UsageError;
use crate::output::stdout::{print_note, print_result};

/// Frames of a path that is made up, unless `--frames` says otherwise.
const FRAMES: usize = 60;

/// What `render.json` holds.
#[derive(Debug, Serialize)]
struct Report {
    scene: String,
    /// As it was typed.
    path: String,
    /// How the tokens of a frame were chosen; `null` where all are used.
    selection: Option<&'static str>,
    device: &'static str,
    height: usize,
    width: usize,
    num_frames: usize,
    num_storage_tokens: usize,
    num_render_tokens: usize,
    /// Median seconds per frame.
    select_s: f64,
    /// Median seconds per frame.
    render_s: f64,
    /// Tokens and seconds per frame, measured before; with `--budget-ms`.
    calibration: Option<Vec<(usize, f64)>>,
}

/// Draws a scene file along a path.
pub fn run(args: &RenderArgs) -> anyhow::Result<()> {
    let (scene, _) = Scene::read(&args.scene)?;
    let [width, height] = args.size.unwrap_or([scene.width, scene.height]);
    let device = args.device.unwrap_or_default();
    check_size(&scene, [width, height], args.render.is_some(), device)?;
    frames::refuse_existing(&args.out)?;
    let views = path(&scene, args, height, width)?;
    let model = args.model.clone().unwrap_or_else(|| scene.model_path.clone().into());
    let weights = ModelPath::for_tokens(&model, scene.kind);
    if args.model.is_none() && !weights.exists() {
        // The path is out of a file from anywhere: no control character of it reaches the terminal.
        let path = weights.display().to_string();
        let message = format!("the scene was encoded with {}, which is not there", path.escape_debug());
        return Err(UsageError(format!("{message}; give the run with --model RUN")).into());
    }
    let stop = crate::interrupt::flag()?;
    let opened = device.open()?;
    args.precision.check("--precision", &opened)?;
    let _precision = args.precision.scope();
    let renderer = load_renderer(&scene, &weights, &opened)?;
    let mut viewer = SceneRenderer::new(&scene, renderer, args.selection.rules(), &opened)?;
    let (num_render_tokens, calibration) = tokens(&scene, args, &mut viewer, &views[0], height, width)?;
    // Nothing is in the folder before everything is.
    let making = || format!("making {}", args.out.display());
    let files = StagedDir::new(&args.out).with_context(making)?;
    let frames = Frames { height, width, num_render_tokens, fps: args.fps };
    let timing = frames::write_frames(&mut viewer, &views, &frames, files.path(), &stop)?;
    let report = Report {
        scene: scene.key.clone(),
        path: args.path.to_string(),
        selection: (num_render_tokens < scene.num_tokens()).then(|| args.selection.name()),
        device: device.as_str(),
        height,
        width,
        num_frames: views.len(),
        num_storage_tokens: scene.num_tokens(),
        num_render_tokens,
        select_s: timing.select_s,
        render_s: timing.render_s,
        calibration: calibration.map(|times| times.some.into_iter().chain([times.all]).collect()),
    };
    let json = serde_json::to_vec_pretty(&report).context("writing the report as JSON")?;
    let path = files.path().join("render.json");
    replace_file(&path, &json).with_context(|| format!("writing {}", path.display()))?;
    files.keep().with_context(making)?;
    print_result(&format!(
        "{}: {} frames of {width} x {height}, each from {num_render_tokens} of {} tokens\n\
         {:.1} ms per frame on {device} (median): {:.1} ms to choose tokens, {:.1} ms to draw",
        args.out.display(),
        views.len(),
        scene.num_tokens(),
        1e3 * (timing.select_s + timing.render_s),
        1e3 * timing.select_s,
        1e3 * timing.render_s,
    ))
}

/// Refuses sizes that are not whole patches, and those that no picture has or this machine cannot draw.
fn check_size(scene: &Scene, [width, height]: [usize; 2], is_some: bool, device: DeviceName) -> anyhow::Result<()> {
    if width.max(height) > MAX_SIDE_PX {
        let message = format!("--size {width}x{height}: write at most {MAX_SIDE_PX} pixels a side");
        return Err(UsageError(message).into());
    }
    let num_patches = scene.model.num_tokens(1, height, width)?;
    // Frames of some tokens are drawn alone, each with its own.
    let num_frames = if is_some { 1 } else { frames_per_call(num_patches) };
    let needed = render_bytes(&scene.model, scene.num_tokens(), num_patches * num_frames);
    if let Some(available) = available_bytes(device).filter(|available| needed > *available) {
        let (needed, available) = (bytes(needed), bytes(available));
        let message = format!(
            "frames of {width} x {height} take {needed} of memory, and {available} are free; choose a smaller --size"
        );
        return Err(UsageError(message).into());
    }
    Ok(())
}

/// How many tokens each frame is drawn from, and what was measured to find out.
fn tokens(
    scene: &Scene,
    args: &RenderArgs,
    viewer: &mut SceneRenderer,
    view: &ViewCamera,
    height: usize,
    width: usize,
) -> anyhow::Result<(usize, Option<RenderBudget>)> {
    let num_storage_tokens = scene.num_tokens();
    let Some(budget_ms) = args.budget_ms else {
        return Ok((args.render.map_or(Ok(num_storage_tokens), |count| count.of(num_storage_tokens))?, None));
    };
    let times = RenderBudget::measure(viewer, view, height, width)?;
    for (count, seconds) in times.some.iter().chain([&times.all]) {
        print_note(&format!("measured: {count} tokens, {:.1} ms per frame", 1e3 * seconds));
    }
    let Some(count) = times.most_tokens(budget_ms / 1e3) else {
        let least_ms = (1e4 * times.least_s()).ceil() / 10.0;
        let message = format!("no frame takes less than {least_ms} ms here; write at least --budget-ms {least_ms}");
        return Err(UsageError(format!("{message}, or a smaller --size")).into());
    };
    print_note(&format!("{budget_ms} ms per frame: {count} of {num_storage_tokens} tokens"));
    Ok((count, Some(times)))
}

/// The views of the path, in pixels of the pictures to draw.
fn path(scene: &Scene, args: &RenderArgs, height: usize, width: usize) -> anyhow::Result<Vec<ViewCamera>> {
    let context = scene.context.iter().map(|view| {
        let ViewCamera { c2w, intrinsics: [fx, fy, cx, cy] } =
            view.resized([scene.height, scene.width], [height, width]);
        Ok(PathView { c2w: Pose::from_matrix(&c2w)?, intrinsics: Intrinsics { fx, fy, cx, cy } })
    });
    let context = context.collect::<anyhow::Result<Vec<_>>>()?;
    let views = match &args.path {
        CameraPath::Interpolate => interpolate_path(&context, args.frames.unwrap_or(FRAMES)),
        CameraPath::Orbit => orbit_path(&context, args.frames.unwrap_or(FRAMES)),
        CameraPath::File(file) => {
            if args.frames.is_some() {
                return Err(
                    UsageError("a file of poses has its own number of frames: leave --frames out".into()).into()
                );
            }
            if !file.exists() {
                let message = "there is no such file; write interpolate, orbit, or a file of poses";
                return Err(UsageError(format!("--path {}: {message}", file.display())).into());
            }
            let mean_c2w = Pose::from_matrix(&scene.world.mean_c2w)?;
            let frame = PoseNormalization { mean_c2w, scale: scene.world.scale };
            let default = mean_intrinsics(&context).context("a scene without context views")?;
            read_poses(file, &frame, default, width, height)?
        }
    };
    let camera = |view: &PathView| {
        let Intrinsics { fx, fy, cx, cy } = view.intrinsics;
        ViewCamera { c2w: view.c2w.to_matrix_f64(), intrinsics: [fx, fy, cx, cy] }
    };
    let views: Vec<ViewCamera> = views.iter().map(camera).collect();
    if views.is_empty() {
        let fix = "write at least 1".into();
        return Err(ModelError::BadConfig { key: "frames", value: "0".into(), fix }.into());
    }
    Ok(views)
}
