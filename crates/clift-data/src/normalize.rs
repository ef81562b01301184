//! The normalised frame of a scene: context cameras centred at the origin, turned to their mean, scaled to a largest
//! coordinate of one.

use serde::{Deserialize, Serialize};

use crate::camera::{Pose, cross, dot};
use crate::error::DataError;

/// How the mean orientation of the context cameras is taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PoseRotation {
    /// Mean of unit quaternions: the reference's choice for RealEstate10K.
    ///
    // Departs from the reference: quaternions are aligned to the first camera's instead of to w >= 0, because near
    // half a turn from the world's axes the latter cancel. Away from there both are the same.
    #[default]
    Quaternion,
    /// Mean viewing direction, with the mean down direction made perpendicular to it: the reference's for DL3DV.
    Axes,
}

/// Which cameras set the scale.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PoseScale {
    /// Context cameras alone, so that tokens do not depend on which targets are asked for.
    #[default]
    Context,
    /// Context and target cameras: the reference's choice for RealEstate10K.
    All,
}

/// A scene's normalised frame: maps world poses to poses around the origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SceneFrame {
    /// Mean context camera, camera to world.
    pub mean_c2w: Pose,
    /// Normalised units per world unit.
    pub scale: f64,
}

/// Largest coordinate that a camera of a clip may have in the normalised frame, whose contexts reach to 1.
///
/// Farther away colours drown in the rays' moments: f32 keeps seven digits of their sum (docs/results/stability.md). The
/// reference draws other views beyond the same number.
pub const MAX_COORDINATE: f64 = 1e3;

impl SceneFrame {
    /// Finds the frame of `context`, camera-to-world poses; `target` counts for [`PoseScale::All`] alone.
    ///
    /// # Errors
    /// [`DataError::InFrame`] around [`DataError::BadCamera`] for a pose that is not finite (the frame is the position
    /// in `context`, then `target`), [`DataError::BadCamera`] for no context or opposite viewing directions, and
    /// [`DataError::ZeroBaseline`] when the centres that set the scale coincide: within 4 f32 epsilons of their
    /// largest coordinate, the steps in which files give them.
    pub fn find(
        key: &str,
        context: &[Pose],
        target: &[Pose],
        rotation: PoseRotation,
        scale: PoseScale,
    ) -> Result<Self, DataError> {
        for (frame, pose) in context.iter().chain(target).enumerate() {
            check_finite(pose).map_err(|source| DataError::InFrame {
                key: key.to_owned(),
                frame,
                source: Box::new(source),
            })?;
        }
        if context.is_empty() {
            return Err(DataError::BadCamera { what: format!("scene {key} has no context views to normalise by") });
        }
        let mean_rotation = match rotation {
            PoseRotation::Quaternion => mean_quaternion(context),
            PoseRotation::Axes => mean_axes(context).ok_or_else(|| DataError::BadCamera {
                what: format!("the context views of scene {key} look in opposite directions, so they have no mean"),
            })?,
        };
        let count = context.len() as f64;
        let centre = [0, 1, 2].map(|i| context.iter().map(|pose| pose.translation[i] / count).sum());
        let unscaled = Self { mean_c2w: Pose { rotation: mean_rotation, translation: centre }, scale: 1.0 };
        let counted: Vec<&Pose> = match scale {
            PoseScale::Context => context.iter().collect(),
            PoseScale::All => context.iter().chain(target).collect(),
        };
        let extent = largest(counted.iter().map(|pose| unscaled.normalize(**pose).translation));
        let threshold = 4.0 * f64::from(f32::EPSILON) * largest(counted.iter().map(|pose| pose.translation));
        if extent <= threshold {
            return Err(DataError::ZeroBaseline { key: key.to_owned(), num_views: counted.len(), extent, threshold });
        }
        Ok(Self { scale: 1.0 / extent, ..unscaled })
    }

    /// Moves a camera-to-world pose from the world into this frame.
    pub fn normalize(&self, c2w: Pose) -> Pose {
        // The difference of centres first: at a million units from the origin `R^T c - R^T mean` would lose digits.
        let mean = self.mean_c2w.translation;
        let offset = [0, 1, 2].map(|i| c2w.translation[i] - mean[i]);
        let to_mean = Pose { translation: [0.0; 3], ..self.mean_c2w }.inverse();
        let moved = to_mean.after(Pose { translation: offset, ..c2w });
        Pose { translation: moved.translation.map(|value| value * self.scale), ..moved }
    }
}

/// Refuses a normalised pose beyond [`MAX_COORDINATE`].
pub(crate) fn check_near(pose: &Pose) -> Result<(), DataError> {
    let coordinate = largest([pose.translation].into_iter());
    if coordinate <= MAX_COORDINATE {
        return Ok(());
    }
    let what = format!(
        "it stands {coordinate:.0} times the contexts' extent away; expected at most {MAX_COORDINATE}, beyond which f32 \
         loses the colours beside the rays"
    );
    Err(DataError::BadCamera { what })
}

fn check_finite(pose: &Pose) -> Result<(), DataError> {
    let mut values = pose.rotation.iter().flatten().chain(&pose.translation);
    match values.find(|value| !value.is_finite()) {
        Some(value) => Err(DataError::BadCamera { what: format!("the pose holds {value}") }),
        None => Ok(()),
    }
}

/// Largest absolute coordinate.
fn largest(points: impl Iterator<Item = [f64; 3]>) -> f64 {
    points.flatten().fold(0.0, |largest: f64, value| largest.max(value.abs()))
}

/// Mean of unit quaternions as a rotation. Each is aligned to the first, so the sum is never zero.
fn mean_quaternion(poses: &[Pose]) -> [[f64; 3]; 3] {
    let first = quaternion(&poses[0].rotation);
    let mut sum = [0.0; 4];
    for pose in poses {
        let q = quaternion(&pose.rotation);
        let sign = 1.0_f64.copysign(q.iter().zip(&first).map(|(a, b)| a * b).sum());
        for (sum, value) in sum.iter_mut().zip(q) {
            *sum += sign * value;
        }
    }
    let norm = sum.iter().map(|value| value * value).sum::<f64>().sqrt();
    from_quaternion(sum.map(|value| value / norm))
}

/// Rotation of a unit quaternion (w, x, y, z).
pub(crate) fn from_quaternion([w, x, y, z]: [f64; 4]) -> [[f64; 3]; 3] {
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

/// Unit quaternion (w, x, y, z) of a rotation, from the largest of its four squared components.
pub(crate) fn quaternion(r: &[[f64; 3]; 3]) -> [f64; 4] {
    let [xx, yy, zz] = [r[0][0], r[1][1], r[2][2]];
    let squares = [1.0 + xx + yy + zz, 1.0 + xx - yy - zz, 1.0 - xx + yy - zz, 1.0 - xx - yy + zz];
    let [wx, wy, wz] = [r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]];
    let [xy, xz, yz] = [r[0][1] + r[1][0], r[0][2] + r[2][0], r[1][2] + r[2][1]];
    let largest = (0..4).fold(0, |best, i| if squares[i] > squares[best] { i } else { best });
    // Four times the products of the largest component with all four.
    let products = match largest {
        0 => [squares[0], wx, wy, wz],
        1 => [wx, squares[1], xy, xz],
        2 => [wy, xy, squares[2], yz],
        _ => [wz, xz, yz, squares[3]],
    };
    let norm = products.iter().map(|value| value * value).sum::<f64>().sqrt();
    products.map(|value| value / norm)
}

/// Mean viewing direction and the mean down direction beside it; `None` when directions cancel.
fn mean_axes(poses: &[Pose]) -> Option<[[f64; 3]; 3]> {
    let mean = |column: usize| [0, 1, 2].map(|row| poses.iter().map(|pose| pose.rotation[row][column]).sum());
    let forward = unit(mean(2), poses.len())?;
    let right = unit(cross(mean(1), forward), poses.len())?;
    let down = cross(forward, right);
    Some([0, 1, 2].map(|row| [right[row], down[row], forward[row]]))
}

/// Direction of a sum of `count` unit vectors, unless what is left of them is rounding.
fn unit(sum: [f64; 3], count: usize) -> Option<[f64; 3]> {
    let norm = dot(sum, sum).sqrt();
    (norm > 1e-6 * count as f64).then(|| sum.map(|value| value / norm))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_is_near_up_to_the_edge() {
        let at =
            |x: f64| Pose { rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], translation: [0.0, x, 0.0] };
        assert!(check_near(&at(-MAX_COORDINATE)).is_ok());
        let message = check_near(&at(-1.01 * MAX_COORDINATE)).unwrap_err().to_string();
        assert!(message.contains("it stands 1010 times the contexts' extent away; expected at most 1000"), "{message}");
    }
    use proptest::prelude::*;
    use safetensors::SafeTensors;

    /// A rotation by `angle` radians about a world axis (0, 1, 2).
    fn turn(axis: usize, angle: f64) -> Pose {
        let (sin, cos) = angle.sin_cos();
        let (i, j) = ((axis + 1) % 3, (axis + 2) % 3);
        let mut pose = Pose::IDENTITY;
        (pose.rotation[i][i], pose.rotation[j][j]) = (cos, cos);
        (pose.rotation[i][j], pose.rotation[j][i]) = (-sin, sin);
        pose
    }

    fn pose(angles: [f64; 3], translation: [f64; 3]) -> Pose {
        let rotation = turn(2, angles[2]).after(turn(1, angles[1])).after(turn(0, angles[0])).rotation;
        Pose { rotation, translation }
    }

    fn walk() -> Vec<Pose> {
        (0..5)
            .map(|i| f64::from(i) * 0.3)
            .map(|t| pose([0.1 * t, 0.4 * t, -0.05], [t, 0.1 * t * t, 0.5 * t.sin()]))
            .collect()
    }

    fn normalized(poses: &[Pose], rotation: PoseRotation, scale: PoseScale) -> Vec<Pose> {
        let (context, target) = poses.split_at(poses.len() - 2);
        let frame = SceneFrame::find("k", context, target, rotation, scale).unwrap();
        poses.iter().map(|pose| frame.normalize(*pose)).collect()
    }

    fn worst(a: &[Pose], b: &[Pose]) -> f64 {
        assert_eq!(a.len(), b.len());
        let values = |poses: &[Pose]| {
            poses
                .iter()
                .flat_map(|pose| pose.rotation.into_iter().chain([pose.translation]))
                .flatten()
                .collect::<Vec<_>>()
        };
        values(a).iter().zip(values(b)).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    }

    const CHOICES: [(PoseRotation, PoseScale, &str); 4] = [
        (PoseRotation::Quaternion, PoseScale::Context, "quaternion.context"),
        (PoseRotation::Quaternion, PoseScale::All, "quaternion.all"),
        (PoseRotation::Axes, PoseScale::Context, "axes.context"),
        (PoseRotation::Axes, PoseScale::All, "axes.all"),
    ];

    #[test]
    fn normalised_poses_equal_numpy_and_scipy() {
        let bytes = include_bytes!("../../../data-fixtures/reference/poses.safetensors");
        let tensors = SafeTensors::deserialize(bytes).unwrap();
        let poses = |name: &str| {
            let data = tensors.tensor(name).unwrap().data();
            let numbers: Vec<f64> = data.as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect();
            let row = |m: &[f64; 16], r: usize| [0, 1, 2, 3].map(|c| m[4 * r + c]);
            let matrices = numbers.as_chunks::<16>().0.iter();
            matrices.map(|m| Pose::from_rows(&[0, 1, 2].map(|r| row(m, r))).unwrap()).collect::<Vec<_>>()
        };
        for case in ["benign", "turned"] {
            let (context, target) = (poses(&format!("{case}.context")), poses(&format!("{case}.target")));
            for (rotation, scale, name) in CHOICES {
                let frame = SceneFrame::find("k", &context, &target, rotation, scale).unwrap();
                let got: Vec<Pose> = context.iter().chain(&target).map(|pose| frame.normalize(*pose)).collect();
                // Coordinates of 30 in f64, a matrix inverse on the other side.
                assert!(worst(&got, &poses(&format!("{case}.{name}"))) < 1e-12, "{case}.{name}");
            }
        }
    }

    #[test]
    fn the_largest_coordinate_is_one_and_the_mean_context_centre_zero() {
        let poses = walk();
        for (rotation, scale, name) in CHOICES {
            let moved = normalized(&poses, rotation, scale);
            let counted = if scale == PoseScale::All { &moved[..] } else { &moved[..3] };
            let extent = largest(counted.iter().map(|pose| pose.translation));
            assert!((extent - 1.0).abs() < 1e-14, "{name}: {extent}");
            for i in 0..3 {
                let mean = moved[..3].iter().map(|pose| pose.translation[i]).sum::<f64>() / 3.0;
                assert!(mean.abs() < 1e-14, "{name}: {mean}");
            }
        }
    }

    #[test]
    fn targets_change_nothing_unless_they_set_the_scale() {
        let mut poses = walk();
        let before = CHOICES.map(|(rotation, scale, _)| normalized(&poses, rotation, scale)[0]);
        poses[4].translation[0] += 100.0;
        let after = CHOICES.map(|(rotation, scale, _)| normalized(&poses, rotation, scale)[0]);
        for ((_, scale, name), (before, after)) in CHOICES.iter().zip(before.iter().zip(&after)) {
            assert_eq!(before == after, *scale == PoseScale::Context, "{name}");
        }
    }

    proptest! {
        #[test]
        fn moving_and_scaling_the_world_changes_nothing(
            angles in prop::array::uniform3(-3.2_f64..3.2),
            shift in prop::array::uniform3(-100.0_f64..100.0),
            scale in 0.01_f64..100.0,
        ) {
            let world = pose(angles, shift);
            let poses = walk();
            let moved: Vec<Pose> = poses
                .iter()
                .map(|pose| world.after(Pose { translation: pose.translation.map(|value| value * scale), ..*pose }))
                .collect();
            for (rotation, scale, name) in CHOICES {
                let difference = worst(&normalized(&poses, rotation, scale), &normalized(&moved, rotation, scale));
                // Centres of up to 200 lose 200 * 2^-52 of an extent of 0.01 * 0.3.
                prop_assert!(difference < 1e-10, "{}: {}", name, difference);
            }
        }
    }

    #[test]
    fn cameras_a_million_units_away_keep_nine_digits() {
        let poses = walk();
        let far: Vec<Pose> =
            poses.iter().map(|pose| Pose { translation: pose.translation.map(|v| 10.0 * v + 1e6), ..*pose }).collect();
        for (rotation, scale, name) in CHOICES {
            // 1e6 * 2^-52 over an extent of a few units.
            assert!(worst(&normalized(&poses, rotation, scale), &normalized(&far, rotation, scale)) < 1e-9, "{name}");
        }
    }

    #[test]
    fn cameras_on_both_sides_of_half_a_turn_have_their_mean_between_them() {
        // 179 and 181 degrees about y. With w >= 0 their quaternions nearly cancel and the mean turns about nothing.
        let context = [179.0_f64, 181.0].map(|angle| pose([0.0, angle.to_radians(), 0.0], [angle, 0.0, 0.0]));
        let frame = SceneFrame::find("k", &context, &[], PoseRotation::Quaternion, PoseScale::Context).unwrap();
        let expected = turn(1, 180.0_f64.to_radians());
        assert!(worst(&[Pose { translation: [0.0; 3], ..frame.mean_c2w }], &[expected]) < 1e-14, "{frame:?}");
    }

    #[test]
    fn identical_centres_are_an_error_that_says_so() {
        let turned = [0.0, 0.1, 0.2].map(|angle| pose([0.0, angle, 0.0], [1e6, 2.0, 3.0]));
        let find = |context: &[Pose]| {
            SceneFrame::find("00ff", context, &[], PoseRotation::Quaternion, PoseScale::Context)
                .map(|frame| frame.scale)
        };
        let message = find(&turned).unwrap_err().to_string();
        assert!(message.starts_with("scene 00ff has no baseline: its 3 camera centres"), "{message}");
        // Beside the threshold of 4 f32 steps at a million, 0.477: apart by less is rounding, by more is a baseline.
        let apart = |extent: f64| {
            let mut poses = turned;
            poses[1].translation[1] += 3.0 * extent / 2.0; // the mean moves by a third of it
            poses
        };
        assert!(find(&apart(0.45)).is_err());
        assert!(find(&apart(0.55)).is_ok());
        assert!(find(&turned.map(|pose| Pose { translation: [0.0; 3], ..pose })).is_err());
        // With f64 centres near the origin a tiny baseline is a baseline.
        assert!(
            find(
                &walk().iter().map(|p| Pose { translation: p.translation.map(|v| v * 1e-9), ..*p }).collect::<Vec<_>>()
            )
            .is_ok()
        );
    }

    #[test]
    fn a_pose_that_is_not_finite_names_its_frame() {
        let mut poses = walk();
        poses[3].translation[1] = f64::NAN;
        let (context, target) = poses.split_at(2);
        let message =
            SceneFrame::find("00ff", context, target, PoseRotation::Axes, PoseScale::All).unwrap_err().to_string();
        assert_eq!(message, "frame 3 of scene 00ff: bad camera: the pose holds NaN");
    }

    #[test]
    fn opposite_viewing_directions_have_no_mean_axes() {
        let context = [0.0, std::f64::consts::PI].map(|angle| pose([0.0, angle, 0.0], [angle, 0.0, 0.0]));
        let message =
            SceneFrame::find("00ff", &context, &[], PoseRotation::Axes, PoseScale::Context).unwrap_err().to_string();
        assert!(message.contains("opposite directions"), "{message}");
    }
}
