//! Pose normalisation of a scene: the mean context camera becomes the origin, the largest coordinate becomes 1.

use glam::{DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};

use crate::error::CameraError;
use crate::geometry::pose::{Pose, unit_quaternion};

/// Definition of the mean orientation of the context cameras.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PoseRotation {
    /// Mean of unit quaternions: the choice of the released code for RealEstate10K.
    ///
    // Departs from the released code, which aligns quaternions to w >= 0: those near half a turn from the world's axes
    // cancel. Alignment to the first camera's quaternion is equal elsewhere.
    #[default]
    Quaternion,
    /// Mean viewing direction, and the perpendicular part of the mean down direction: the choice of the released code for DL3DV.
    Axes,
}

/// Which cameras determine the scale.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PoseScale {
    /// Context cameras only, so that tokens do not depend on the targets.
    #[default]
    Context,
    /// Context and target cameras: the choice of the released code for RealEstate10K.
    All,
}

/// The normalised frame of a scene. Maps world poses to poses around the origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseNormalization {
    /// Mean context camera, camera to world.
    pub mean_c2w: Pose,
    /// Normalised units per world unit.
    pub scale: f64,
}

/// Largest accepted coordinate of a camera in the normalised frame, in which contexts reach to 1.
///
/// Beyond this bound the moments of the rays outweigh the colours in f32 sums (docs/results/stability.md). The
/// reference discards such samples at the same bound.
pub const MAX_COORDINATE: f64 = 1e3;

impl PoseNormalization {
    /// Computes the frame of the camera-to-world poses `context`. `target` is used for [`PoseScale::All`] only.
    pub fn find(
        key: &str,
        context: &[Pose],
        target: &[Pose],
        rotation: PoseRotation,
        scale: PoseScale,
    ) -> Result<Self, CameraError> {
        for (frame, pose) in context.iter().chain(target).enumerate() {
            let in_frame = |source| CameraError::InFrame { key: key.to_owned(), frame, source: Box::new(source) };
            pose.check_finite().map_err(in_frame)?;
        }
        if context.is_empty() {
            return Err(CameraError::BadCamera {
                what: format!("scene {key} has no context views, so its poses cannot be normalised"),
            });
        }
        let rotation = match rotation {
            PoseRotation::Quaternion => mean_quaternion(context),
            PoseRotation::Axes => mean_axes(context).ok_or_else(|| CameraError::BadCamera {
                what: format!("the context views of scene {key} look in opposite directions, which have no mean"),
            })?,
        };
        let translation = context.iter().map(|pose| pose.translation / context.len() as f64).sum();
        let unscaled = Self { mean_c2w: Pose { rotation, translation }, scale: 1.0 };
        let counted: Vec<&Pose> = match scale {
            PoseScale::Context => context.iter().collect(),
            PoseScale::All => context.iter().chain(target).collect(),
        };
        let extent = largest(counted.iter().map(|pose| unscaled.normalize(**pose).translation));
        let threshold = 4.0 * f64::from(f32::EPSILON) * largest(counted.iter().map(|pose| pose.translation));
        if extent <= threshold {
            return Err(CameraError::ZeroBaseline { key: key.to_owned(), num_views: counted.len(), extent, threshold });
        }
        Ok(Self { scale: 1.0 / extent, ..unscaled })
    }

    /// Maps a camera-to-world pose from the world into this frame.
    pub fn normalize(&self, c2w: Pose) -> Pose {
        // Centres are subtracted first: far from the origin `R^T c - R^T mean` loses digits.
        let offset = c2w.translation - self.mean_c2w.translation;
        let to_mean = self.mean_c2w.rotation.transpose();
        Pose { rotation: to_mean * c2w.rotation, translation: to_mean * offset * self.scale }
    }
}

/// Checks that a normalised camera is within [`MAX_COORDINATE`] of the origin.
pub fn check_near(pose: &Pose) -> Result<(), CameraError> {
    let coordinate = pose.translation.abs().max_element();
    if coordinate <= MAX_COORDINATE {
        return Ok(());
    }
    let what = format!(
        "the camera is {coordinate:.0} times the contexts' extent away, expected at most {MAX_COORDINATE}: beyond that \
         f32 sums lose the colours"
    );
    Err(CameraError::BadCamera { what })
}

fn largest(points: impl Iterator<Item = DVec3>) -> f64 {
    points.fold(0.0, |largest, point| point.abs().max_element().max(largest))
}

/// Returns the mean of the unit quaternions as a rotation. Each is aligned to the first, so the sum is never zero.
fn mean_quaternion(poses: &[Pose]) -> DMat3 {
    let first = poses[0].quaternion();
    let aligned = |q: DQuat| q * 1.0_f64.copysign(q.dot(first));
    let sum: DQuat = poses.iter().map(|pose| aligned(pose.quaternion())).sum();
    DMat3::from_quat(unit_quaternion(sum))
}

/// Returns the mean of [`PoseRotation::Axes`], `None` if directions cancel.
fn mean_axes(poses: &[Pose]) -> Option<DMat3> {
    let sum = |axis: usize| poses.iter().map(|pose| pose.rotation.col(axis)).sum::<DVec3>();
    let forward = unit(sum(2), poses.len())?;
    let right = unit(sum(1).cross(forward), poses.len())?;
    Some(DMat3::from_cols(right, forward.cross(right), forward))
}

/// Returns the direction of a sum of `count` unit vectors, `None` if the sum is zero up to rounding.
fn unit(sum: DVec3, count: usize) -> Option<DVec3> {
    let length = sum.length();
    (length > 1e-6 * count as f64).then(|| sum / length)
}

#[cfg(test)]
mod tests {
    use super::*;
    use safetensors::SafeTensors;

    fn pose([x, y, z]: [f64; 3], translation: [f64; 3]) -> Pose {
        let rotation = DMat3::from_rotation_z(z) * DMat3::from_rotation_y(y) * DMat3::from_rotation_x(x);
        Pose { rotation, translation: translation.into() }
    }

    fn worst(a: &[Pose], b: &[Pose]) -> f64 {
        assert_eq!(a.len(), b.len());
        let values = |poses: &[Pose]| poses.iter().flat_map(|pose| pose.to_matrix_f64()).collect::<Vec<_>>();
        values(a).iter().zip(values(b)).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    }

    #[test]
    fn normalised_poses_equal_numpy_and_scipy_near_and_far_from_the_origin() {
        let bytes = include_bytes!("../../../../data-fixtures/reference/poses.safetensors");
        let tensors = SafeTensors::deserialize(bytes).unwrap();
        let poses = |name: &str| {
            let data = tensors.tensor(name).unwrap().data();
            let numbers: Vec<f64> = data.as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect();
            numbers.as_chunks().0.iter().map(|matrix| Pose::from_matrix(matrix).unwrap()).collect::<Vec<_>>()
        };
        for case in ["benign", "turned"] {
            let (context, target) = (poses(&format!("{case}.context")), poses(&format!("{case}.target")));
            for (rotation, scale, name) in [
                (PoseRotation::Quaternion, PoseScale::Context, "quaternion.context"),
                (PoseRotation::Quaternion, PoseScale::All, "quaternion.all"),
                (PoseRotation::Axes, PoseScale::Context, "axes.context"),
                (PoseRotation::Axes, PoseScale::All, "axes.all"),
            ] {
                // Coordinates of 30 in f64 and a matrix inverse on the other side; 1e6 * 2^-52 over an extent of units.
                for (offset, tolerance) in [(0.0, 1e-12), (1e6, 1e-9)] {
                    let far = |pose: &Pose| Pose { translation: pose.translation + offset, ..*pose };
                    let [context, target] = [&context, &target].map(|poses| poses.iter().map(far).collect::<Vec<_>>());
                    let frame = PoseNormalization::find("k", &context, &target, rotation, scale).unwrap();
                    let got: Vec<Pose> = context.iter().chain(&target).map(|pose| frame.normalize(*pose)).collect();
                    let difference = worst(&got, &poses(&format!("{case}.{name}")));
                    assert!(difference < tolerance, "{case}.{name} at {offset}: {difference}");
                }
            }
        }
    }

    #[test]
    fn cameras_around_half_a_turn_have_their_mean_between() {
        // 179 and 181 degrees about y. With w >= 0 their quaternions nearly cancel and the mean turns about nothing.
        let context = [179.0_f64, 181.0].map(|angle| pose([0.0, angle.to_radians(), 0.0], [angle, 0.0, 0.0]));
        let frame = PoseNormalization::find("k", &context, &[], PoseRotation::Quaternion, PoseScale::Context).unwrap();
        let expected = pose([0.0, std::f64::consts::PI, 0.0], [180.0, 0.0, 0.0]);
        assert!(worst(&[frame.mean_c2w], &[expected]) < 1e-14, "{frame:?}");
    }

    #[test]
    fn poses_without_a_frame_are_refused() {
        let turned = [0.0, 0.1, 0.2].map(|angle| pose([0.0, angle, 0.0], [1e6, 2.0, 3.0]));
        let find = |context: &[Pose], rotation| {
            let frame = PoseNormalization::find("00ff", context, &[], rotation, PoseScale::Context);
            frame.map_err(|error| error.to_string())
        };
        let message = find(&turned, PoseRotation::Quaternion).unwrap_err();
        assert!(message.starts_with("scene 00ff has no baseline: its 3 camera centres"), "{message}");
        // The threshold is 4 f32 epsilons of a million: 0.477.
        let apart = |extent: f64| {
            let mut poses = turned;
            poses[1].translation[1] += 3.0 * extent / 2.0; // the mean moves by a third of it
            find(&poses, PoseRotation::Quaternion).is_ok()
        };
        assert!(!apart(0.45) && apart(0.55));
        // Near the origin a tiny baseline of f64 centres is accepted.
        let tiny = [0.0, 1e-9].map(|x| pose([0.0; 3], [x, 0.0, 0.0]));
        assert!(find(&tiny, PoseRotation::Quaternion).is_ok());
        let opposite = [0.0, std::f64::consts::PI].map(|angle| pose([0.0, angle, 0.0], [angle, 0.0, 0.0]));
        let message = find(&opposite, PoseRotation::Axes).unwrap_err();
        assert!(message.contains("opposite directions"), "{message}");
    }
}
