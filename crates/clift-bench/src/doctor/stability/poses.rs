//! Pose normalization of scenes whose cameras are far away or close together.

use clift_core::{Camera, CameraError, Pose, PoseNormalization, PoseRotation, PoseScale};
use clift_data::DataError;
use clift_train::{ClipShape, TrainError, seeded_clip};

use crate::cases::reference::largest_magnitude;
use crate::doctor::stability::case::{Bound, Outcome, StabilityCase};

pub(crate) const CASES: &[StabilityCase] = &[
    StabilityCase {
        name: "world 1e6 from the origin, normalised",
        breaks: "differences of large coordinates",
        bound: Bound::Most(1e-8),
        reason: "an f64 step at 1e6 is 1.2e-10, the scene has a size of 1; against the same scene at the origin",
        run: |_| normalization_error(1e6, 1.0, false),
    },
    StabilityCase {
        name: "the same with poses in f32, as chunks hold them",
        breaks: "the file itself",
        bound: Bound::Most(0.2),
        reason: "an f32 step at 1e6 is 0.06: what the file has lost no reader finds again",
        run: |_| normalization_error(1e6, 1.0, true),
    },
    StabilityCase {
        name: "baseline of 1e-6 at a distance of 1, normalised",
        breaks: "the division by the scene's size",
        bound: Bound::Most(1e-8),
        reason: "an f64 step at 1 is 2.2e-16, over a size of 1e-6",
        run: |_| normalization_error(1.0, 1e-6, false),
    },
    StabilityCase {
        name: "baseline of 1e-7 at a distance of 1",
        breaks: "a scale made of rounding",
        bound: Bound::Refused("has no baseline"),
        reason: "below four f32 steps the poses of a file say nothing",
        run: |_| normalization_error(1.0, 1e-7, false),
    },
    StabilityCase {
        name: "zero baseline, normalised",
        breaks: "a division by zero",
        bound: Bound::Refused("has no baseline"),
        reason: "there is no scale",
        run: |_| normalization_error(0.0, 0.0, false),
    },
];

/// Returns the largest difference between the normalized poses of a scene and those of the scene scaled by `baseline` and
/// moved by `distance`.
fn normalization_error(distance: f64, baseline: f64, in_f32: bool) -> Result<Outcome, TrainError> {
    let clip = seeded_clip(ClipShape { num_context: 4, num_targets: 1, size: [8, 8] }, 0, 0);
    // Coordinates that binary numbers do not represent exactly.
    let scaled = |camera: &Camera| Pose { translation: camera.c2w.translation * 1.1, ..camera.c2w };
    let moved = |pose: &Pose| {
        let translation = baseline * pose.translation + distance;
        let round = |value: f64| if in_f32 { f64::from(value as f32) } else { value };
        Pose { translation: translation.map(round), ..*pose }
    };
    let here: Vec<Pose> = clip.context.cameras.iter().map(scaled).collect();
    let away: Vec<Pose> = here.iter().map(moved).collect();
    let [here, away] = [here, away].map(|poses| {
        let frame = PoseNormalization::find("far", &poses, &[], PoseRotation::default(), PoseScale::default())?;
        Ok::<_, DataError>(poses.iter().map(|pose| frame.normalize(*pose)).collect::<Vec<_>>())
    });
    let away = match away {
        Ok(away) => away,
        Err(DataError::Camera(CameraError::ZeroBaseline { .. })) => {
            return Ok(Outcome::Refused(away.expect_err("it is one").to_string()));
        }
        Err(other) => return Err(other.into()),
    };
    let pairs = here?.into_iter().zip(away);
    let differences = pairs.flat_map(|(a, b)| {
        let [a, b] = [a, b].map(Pose::to_matrix_f64);
        (0..16).map(move |i| a[i] - b[i])
    });
    Ok(Outcome::Error(largest_magnitude(differences)))
}
