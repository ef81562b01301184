//! Whole updates, loss and gradients, on views that are hard.

use clift_data::{Clip, ClipViews, MAX_COORDINATE};
use clift_model::ModelConfig;
use clift_train::{Shape, StageBatch, TrainError, seeded_batch, seeded_model};

use crate::doctor::stability::case::{Bound, Case, CaseDevices, Outcome};
use crate::doctor::stability::compare::update_error;

/// f32 through a few blocks, forward and backward, as the tests of single blocks have it, times the blocks.
const GRADIENT: Bound = Bound::Most(1e-4);
const GRADIENT_REASON: &str = "f32 through every block, forward and back: 1e-5 a block";

pub(crate) const CASES: &[Case] = &[
    Case {
        name: "identical contexts",
        breaks: "scores of tokens that are equal",
        bound: GRADIENT,
        reason: GRADIENT_REASON,
        run: |place| {
            changed(place, 4, |clip| {
                let views = &mut clip.context;
                let picture = views.images[..views.images.len() / views.c2w.len()].to_vec();
                views.images = picture.repeat(views.c2w.len());
                views.c2w = vec![views.c2w[0]; views.c2w.len()];
            })
        },
    },
    Case {
        name: "zero baseline: every camera at the origin",
        breaks: "moments that are zero",
        bound: GRADIENT,
        reason: GRADIENT_REASON,
        run: |place| changed(place, 4, |clip| move_cameras(clip, |x| 0.0 * x)),
    },
    Case {
        name: "cameras 1e-6 apart",
        breaks: "moments that nearly cancel",
        bound: GRADIENT,
        reason: GRADIENT_REASON,
        run: |place| changed(place, 4, |clip| move_cameras(clip, |x| 1e-6 * x)),
    },
    Case {
        name: "cameras 1e3 from the contexts, the most a clip may have",
        breaks: "moments of 1e3 beside colours of 1",
        bound: Bound::Most(1e-3),
        reason: "the first layer adds colours to a thousand times as much, so that f32 has three digits less of them",
        run: |place| {
            changed(place, 4, |clip| {
                for pose in clip.context.c2w.iter_mut().chain(&mut clip.target.c2w) {
                    pose.translation += MAX_COORDINATE;
                }
            })
        },
    },
    Case {
        name: "field of view of 5 degrees",
        breaks: "rays that are nearly parallel",
        bound: GRADIENT,
        reason: GRADIENT_REASON,
        run: |place| changed(place, 4, |clip| field_of_view(clip, 5.0)),
    },
    Case {
        name: "field of view of 150 degrees",
        breaks: "the length of rays at the edge",
        bound: GRADIENT,
        reason: GRADIENT_REASON,
        run: |place| changed(place, 4, |clip| field_of_view(clip, 150.0)),
    },
    Case {
        name: "target is a context",
        breaks: "scores of a ray with itself",
        bound: GRADIENT,
        reason: GRADIENT_REASON,
        run: |place| {
            changed(place, 4, |clip| {
                let len = clip.context.images.len() / clip.context.c2w.len();
                for (target, pose) in clip.target.c2w.iter_mut().enumerate() {
                    *pose = clip.context.c2w[target];
                    clip.target.images[target * len..][..len]
                        .copy_from_slice(&clip.context.images[target * len..][..len]);
                }
            })
        },
    },
    Case {
        name: "black pictures",
        breaks: "patches that are constant, a target at the edge of the sigmoid",
        bound: GRADIENT,
        reason: GRADIENT_REASON,
        run: |place| changed(place, 4, |clip| paint(clip, |_| 0)),
    },
    Case {
        name: "white pictures",
        breaks: "the same at its other edge",
        bound: GRADIENT,
        reason: GRADIENT_REASON,
        run: |place| changed(place, 4, |clip| paint(clip, |_| 255)),
    },
    Case {
        name: "saturated pictures: every value 0 or 255",
        breaks: "the largest differences there can be",
        bound: GRADIENT,
        reason: GRADIENT_REASON,
        run: |place| changed(place, 4, |clip| paint(clip, |value| if value > 127 { 255 } else { 0 })),
    },
    Case {
        name: "1 context",
        breaks: "nothing to attend to in other views",
        bound: GRADIENT,
        reason: GRADIENT_REASON,
        run: |place| changed(place, 1, |_| ()),
    },
    Case {
        name: "2 contexts",
        breaks: "sums over more and more tokens",
        bound: GRADIENT,
        reason: GRADIENT_REASON,
        run: |place| changed(place, 2, |_| ()),
    },
    Case {
        name: "8 contexts",
        breaks: "sums over more and more tokens",
        bound: GRADIENT,
        reason: GRADIENT_REASON,
        run: |place| changed(place, 8, |_| ()),
    },
    Case {
        name: "16 contexts",
        breaks: "sums over more and more tokens",
        bound: GRADIENT,
        reason: GRADIENT_REASON,
        run: |place| changed(place, 16, |_| ()),
    },
];

/// The network of the cases.
pub(crate) fn network(place: &CaseDevices) -> ModelConfig {
    ModelConfig {
        dim: place.size.pick(16, 64),
        num_heads: 4,
        feed_forward_dim: place.size.pick(24, 128),
        num_encoder_blocks: place.size.pick(1, 3),
        num_renderer_blocks: place.size.pick(1, 3),
        ..ModelConfig::default()
    }
}

/// Two targets of so many contexts.
pub(crate) fn shape(place: &CaseDevices, num_context: usize) -> Shape {
    let side = place.size.pick(16, 64);
    Shape { num_context, num_targets: if num_context == 1 { 1 } else { 2 }, size: [side, side] }
}

/// Tokens of such a scene.
pub(crate) fn num_tokens(place: &CaseDevices, num_context: usize) -> usize {
    let [height, width] = shape(place, num_context).size;
    num_context * (height / 8) * (width / 8)
}

/// The error of an update of stage 1 on a scene that is changed.
fn changed(place: &CaseDevices, num_context: usize, change: impl Fn(&mut Clip)) -> Result<Outcome, TrainError> {
    let mut batch: StageBatch = seeded_batch(shape(place, num_context), 1, num_tokens(place, num_context), None, 0)?;
    batch.clips.iter_mut().for_each(change);
    let model = clift_train::freeze(clift_train::Stage::Stage1, seeded_model(&network(place), 0, &place.device));
    Ok(Outcome::Error(update_error(place, &model, &batch)?))
}

fn all_views(clip: &mut Clip) -> [&mut ClipViews; 2] {
    [&mut clip.context, &mut clip.target]
}

fn move_cameras(clip: &mut Clip, to: impl Fn(f64) -> f64) {
    for pose in all_views(clip).into_iter().flat_map(|views| &mut views.c2w) {
        pose.translation = pose.translation.map(&to);
    }
}

fn field_of_view(clip: &mut Clip, degrees: f64) {
    for views in all_views(clip) {
        let focal = views.width as f64 / 2.0 / (degrees / 2.0).to_radians().tan();
        for intrinsics in &mut views.intrinsics {
            (intrinsics.fx, intrinsics.fy) = (focal, focal);
        }
    }
}

fn paint(clip: &mut Clip, color: impl Fn(u8) -> u8) {
    for views in all_views(clip) {
        views.images.iter_mut().for_each(|value| *value = color(*value));
    }
}
