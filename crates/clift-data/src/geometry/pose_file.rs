//! Poses to render, from a file.

use std::ops::RangeInclusive;
use std::path::Path;

use clift_core::{Camera, Intrinsics, IntrinsicsNorm, Pose, PoseNormalization, check_near};
use serde::Deserialize;

use crate::error::DataError;
use crate::files::bounded::{parse_json, read_bounded};

const MAX_BYTES: u64 = 128 << 20;
const MAX_POSES: usize = 100_000;
/// Accepted focal lengths over width and height; the upper bound also limits the principal point's distance from 0.
const INTRINSICS: RangeInclusive<f64> = 1e-3..=1e3;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PoseFile {
    poses: Vec<FilePose>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct FilePose {
    /// Three or four rows of a camera-to-world matrix in the capture's world, OpenCV axes.
    c2w: Vec<[f64; 4]>,
    /// `fx, fy, cx, cy` over width and height. Default: the mean of the context views.
    #[serde(default)]
    intrinsics_norm: Option<[f64; 4]>,
}

/// Reads `{"poses": [{"c2w": [[..4], [..4], [..4]], "intrinsics_norm": [fx, fy, cx, cy]}, ..]}` and normalises the poses.
///
/// Poses are camera to world in the world of the capture's files, OpenCV axes. Images have `width` by `height` pixels.
/// A pose without intrinsics gets `default`.
///
/// # Errors
/// [`DataError::Io`], and [`DataError::BadPoses`] for another form or an invalid pose, with the position of the pose.
pub fn read_poses(
    path: &Path,
    normalization: &PoseNormalization,
    default: Intrinsics,
    width: usize,
    height: usize,
) -> Result<Vec<Camera>, DataError> {
    let text = read_bounded(path, MAX_BYTES, "reading the poses")?;
    let bad = |what: String| DataError::BadPoses { what, path: path.to_path_buf() };
    let PoseFile { poses } = parse_json(&text).map_err(|error: serde_json::Error| {
        bad(format!("expected {{\"poses\": [{{\"c2w\": [[4 numbers] x 3]}}, ..]}}, got {error}"))
    })?;
    if !(1..=MAX_POSES).contains(&poses.len()) {
        return Err(bad(format!("{} poses, expected 1 to {MAX_POSES}", poses.len())));
    }
    let is_near = |cx: f64, cy: f64| [cx, cy].iter().all(|centre| centre.abs() <= *INTRINSICS.end());
    let view = |(position, pose): (usize, FilePose)| {
        let bad = |what: String| bad(format!("pose {position}: {what}"));
        let (rows, last) = match pose.c2w[..] {
            [a, b, c] => ([a, b, c], [0.0, 0.0, 0.0, 1.0]),
            [a, b, c, last] => ([a, b, c], last),
            _ => return Err(bad(format!("{} rows, expected 3 or 4", pose.c2w.len()))),
        };
        if last != [0.0, 0.0, 0.0, 1.0] {
            return Err(bad(format!("the last row is {last:?}, expected [0, 0, 0, 1]")));
        }
        let c2w = normalization.normalize(Pose::from_rows(&rows).map_err(|error| bad(error.to_string()))?);
        check_near(&c2w).map_err(|error| bad(error.to_string()))?;
        let intrinsics = match pose.intrinsics_norm {
            None => default,
            Some([fx, fy, cx, cy]) if INTRINSICS.contains(&fx) && INTRINSICS.contains(&fy) && is_near(cx, cy) => {
                IntrinsicsNorm { fx, fy, cx, cy }.to_pixels(width, height)
            }
            Some(other) => {
                let most = INTRINSICS.end();
                return Err(bad(format!(
                    "intrinsics_norm is {other:?}; expected fx and fy from {} to {most}, cx and cy within {most} of 0",
                    INTRINSICS.start()
                )));
            }
        };
        Ok(Camera { c2w, intrinsics })
    };
    poses.into_iter().enumerate().map(view).collect()
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;
    use crate::testing::read_from_file;

    const K: Intrinsics = Intrinsics { fx: 40.0, fy: 41.0, cx: 16.0, cy: 12.0 };

    fn pose(centre: [f64; 3]) -> Pose {
        Pose { rotation: DMat3::IDENTITY, translation: centre.into() }
    }

    fn assert_close(a: &Camera, b: [f64; 3]) {
        let (a, b) = (a.c2w.to_matrix_f64(), pose(b).to_matrix_f64());
        assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12), "{a:?} {b:?}");
    }

    fn read(json: &str) -> Result<Vec<Camera>, DataError> {
        let frame = PoseNormalization { mean_c2w: pose([1.0, 0.0, 0.0]), scale: 2.0 };
        read_from_file("poses.json", json, |path| read_poses(path, &frame, K, 64, 32))
    }

    #[test]
    fn poses_of_a_file_are_normalised() {
        let views = read(
            r#"{"poses": [{"c2w": [[1,0,0,501],[0,1,0,0],[0,0,1,0.5]]},
                {"c2w": [[1,0,0,1],[0,1,0,0],[0,0,1,0],[0,0,0,1]], "intrinsics_norm": [0.5, 1.0, 0.5, 0.25]}]}"#,
        )
        .unwrap();
        assert_close(&views[0], [1000.0, 0.0, 1.0]);
        assert_eq!(views[0].intrinsics, K);
        assert_close(&views[1], [0.0; 3]);
        assert_eq!(views[1].intrinsics, Intrinsics { fx: 32.0, fy: 32.0, cx: 32.0, cy: 8.0 });
    }

    #[test]
    fn invalid_pose_files_name_pose_and_problem() {
        for (json, part) in [
            ("[]", "expected {\"poses\": "),
            (r#"{"poses": []}"#, "0 poses, expected 1 to 100000"),
            (r#"{"poses": [{"c2w": [[1,0,0,0]]}]}"#, "pose 0: 1 rows, expected 3 or 4"),
            (r#"{"poses": [{"c2w": [[2,0,0,0],[0,1,0,0],[0,0,1,0]]}]}"#, "pose 0: bad camera: the rotation is off"),
            (r#"{"poses": [{"c2w": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,2]]}]}"#, "the last row is"),
            (
                r#"{"poses": [{"c2w": [[1,0,0,0],[0,1,0,0],[0,0,1,0]], "intrinsics_norm": [0,1,0,0]}]}"#,
                "pose 0: intrinsics_norm is [0.0, 1.0",
            ),
            (
                r#"{"poses": [{"c2w": [[1,0,0,0],[0,1,0,0],[0,0,1,0]], "intrinsics_norm": [1,1,1e39,0.5]}]}"#,
                "pose 0: intrinsics_norm is [1.0, 1.0, 1e39",
            ),
            (
                r#"{"poses": [{"c2w": [[1,0,0,506],[0,1,0,0],[0,0,1,0]]}]}"#,
                "pose 0: bad camera: the camera is 1010 times the contexts' extent away",
            ),
            (r#"{"pose": []}"#, "unknown field `pose`"),
        ] {
            let message = read(json).unwrap_err().to_string();
            assert!(message.contains(part) && message.ends_with("poses.json"), "{message}");
        }
    }
}
