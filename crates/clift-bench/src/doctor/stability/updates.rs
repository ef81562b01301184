//! Whole updates, loss and gradients, on extreme views.

use clift_core::{ClipViews, MAX_COORDINATE};
use clift_data::Clip;
use clift_model::{Architecture, CameraEncoding, CondenserConfig, ModelConfig};
use clift_train::{ClipShape, Stage, StageBatch, TrainError, freeze, seeded_batch, seeded_model};

use crate::cases::step::update_error;
use crate::doctor::stability::case::{CaseDevices, StabilityCase};

pub(crate) const CASES: &[StabilityCase] = &[
    StabilityCase::update("identical contexts", "scores of tokens that are equal", |devices| {
        changed_views(devices, 4, |clip| {
            let views = &mut clip.context;
            let image = views.images[..views.images.len() / views.num_views()].to_vec();
            views.images = image.repeat(views.num_views());
            let c2w = views.cameras[0].c2w;
            views.cameras.iter_mut().for_each(|camera| camera.c2w = c2w);
        })
    }),
    StabilityCase::update("zero baseline: every camera at the origin", "moments that are zero", |devices| {
        changed_views(devices, 4, |clip| move_cameras(clip, |x| 0.0 * x))
    }),
    StabilityCase::update("cameras 1e-6 apart", "moments that nearly cancel", |devices| {
        changed_views(devices, 4, |clip| move_cameras(clip, |x| 1e-6 * x))
    }),
    StabilityCase {
        name: "cameras 1e3 from the contexts, the most a clip may have",
        breaks: "moments of 1e3 beside colours of 1",
        bound: 1e-3,
        reason: "the first layer adds colours to a thousand times as much, so that f32 has three digits less of them",
        run: |devices| changed_views(devices, 4, |clip| shift_cameras(clip, MAX_COORDINATE)),
    },
    StabilityCase {
        name: "the same with camera-relative attention (gta)",
        breaks: "positions of 1e3 in the transforms of queries, keys and values",
        bound: 1e-1,
        reason: "scores and values add terms of 1e3 that cancel, twice in each attention; cameras of a clip are within 1",
        run: |devices| relative_views(devices, |clip| shift_cameras(clip, MAX_COORDINATE)),
    },
    StabilityCase::update("camera-relative attention (gta)", "the transforms of queries, keys and values", |devices| {
        relative_views(devices, |_| ())
    }),
    StabilityCase::update("LVSM's encoder-decoder", "latents among patches, norms of queries and keys", lvsm_views),
    StabilityCase::update("field of view of 5 degrees", "rays that are nearly parallel", |devices| {
        changed_views(devices, 4, |clip| field_of_view(clip, 5.0))
    }),
    StabilityCase::update("field of view of 150 degrees", "the length of rays at the edge", |devices| {
        changed_views(devices, 4, |clip| field_of_view(clip, 150.0))
    }),
    StabilityCase::update("target is a context", "scores of a ray with itself", |devices| {
        changed_views(devices, 4, |clip| {
            let len = clip.context.images.len() / clip.context.num_views();
            for (target, camera) in clip.target.cameras.iter_mut().enumerate() {
                camera.c2w = clip.context.cameras[target].c2w;
                clip.target.images[target * len..][..len].copy_from_slice(&clip.context.images[target * len..][..len]);
            }
        })
    }),
    StabilityCase::update(
        "black images",
        "patches that are constant, a target at the edge of the sigmoid",
        |devices| changed_views(devices, 4, |clip| paint(clip, |_| 0)),
    ),
    StabilityCase::update("white images", "the same at its other edge", |devices| {
        changed_views(devices, 4, |clip| paint(clip, |_| 255))
    }),
    StabilityCase::update(
        "saturated images: every value 0 or 255",
        "the largest differences there can be",
        |devices| changed_views(devices, 4, |clip| paint(clip, |value| if value > 127 { 255 } else { 0 })),
    ),
    StabilityCase::update("1 context", "nothing to attend to in other views", |devices| {
        changed_views(devices, 1, |_| ())
    }),
    StabilityCase::update("16 contexts", "sums over more and more tokens", |devices| {
        changed_views(devices, 16, |_| ())
    }),
];

/// Share of the largest gradient below which a gradient counts as rounding noise.
const NOISE_SHARE: f64 = 1e-3;

pub(crate) fn network(devices: &CaseDevices) -> ModelConfig {
    ModelConfig {
        dim: devices.size.pick(16, 64),
        num_heads: 4,
        feed_forward_dim: devices.size.pick(24, 128),
        num_encoder_blocks: devices.size.pick(1, 3),
        num_renderer_blocks: devices.size.pick(1, 3),
        ..ModelConfig::default()
    }
}

/// Returns a batch of scenes of `num_context` contexts and two targets, one target for one context.
pub(crate) fn batch(devices: &CaseDevices, num_context: usize, num_scenes: usize) -> Result<StageBatch, TrainError> {
    let (side, num_targets) = (devices.size.pick(16, 64), if num_context == 1 { 1 } else { 2 });
    seeded_batch(ClipShape { num_context, num_targets, size: [side, side] }, num_scenes, None, 0)
}

fn changed_views(devices: &CaseDevices, num_context: usize, change: impl Fn(&mut Clip)) -> Result<f64, TrainError> {
    network_error(devices, &network(devices), num_context, change)
}

/// Returns the error of an update on changed views with camera-relative attention; heads of 8 or 16 channels.
fn relative_views(devices: &CaseDevices, change: impl Fn(&mut Clip)) -> Result<f64, TrainError> {
    let (camera_encoding, num_heads) = (CameraEncoding::Gta, devices.size.pick(2, 4));
    let config = ModelConfig { camera_encoding, num_heads, ..network(devices) };
    network_error(devices, &config, 4, change)
}

fn lvsm_views(devices: &CaseDevices) -> Result<f64, TrainError> {
    let (num_latents, condenser) = (devices.size.pick(5, 64), CondenserConfig::NONE);
    let architecture = Architecture::LvsmEd;
    let config = ModelConfig { architecture, num_latents, condenser, ..network(devices) };
    network_error(devices, &config, 4, |_| ())
}

fn network_error(
    devices: &CaseDevices,
    config: &ModelConfig,
    num_context: usize,
    change: impl Fn(&mut Clip),
) -> Result<f64, TrainError> {
    let mut batch = batch(devices, num_context, 1)?;
    batch.clips.iter_mut().for_each(change);
    stage_error(devices, config, Stage::Stage1, &batch)
}

pub(crate) fn stage_error(
    devices: &CaseDevices,
    config: &ModelConfig,
    stage: Stage,
    batch: &StageBatch,
) -> Result<f64, TrainError> {
    let model = freeze(stage, seeded_model(config, 0, &devices.device));
    update_error(&model, batch, &devices.device, &devices.reference, NOISE_SHARE)
}

fn all_views(clip: &mut Clip) -> [&mut ClipViews; 2] {
    [&mut clip.context, &mut clip.target]
}

fn move_cameras(clip: &mut Clip, to: impl Fn(f64) -> f64) {
    for camera in all_views(clip).into_iter().flat_map(|views| &mut views.cameras) {
        camera.c2w.translation = camera.c2w.translation.map(&to);
    }
}

fn shift_cameras(clip: &mut Clip, by: f64) {
    for camera in all_views(clip).into_iter().flat_map(|views| &mut views.cameras) {
        camera.c2w.translation += by;
    }
}

fn field_of_view(clip: &mut Clip, degrees: f64) {
    for views in all_views(clip) {
        let focal = views.width as f64 / 2.0 / (degrees / 2.0).to_radians().tan();
        for camera in &mut views.cameras {
            (camera.intrinsics.fx, camera.intrinsics.fy) = (focal, focal);
        }
    }
}

fn paint(clip: &mut Clip, color: impl Fn(u8) -> u8) {
    for views in all_views(clip) {
        views.images.iter_mut().for_each(|value| *value = color(*value));
    }
}
