//! The context views of a scene: requested frames, or frames along the camera path, and how far the views turn.

use clift_core::{Camera, DVec3, Pose, PoseNormalization};
use clift_data::{ClipReader, DataError, SceneSource, contexts_along_path};
use clift_model::{CameraEncoding, ModelConfig, ModelError};

use crate::error::SceneError;

/// Angle between two context views, in degrees, above which `models/rooms` renders noise
/// (models/rooms/README.md, "Limits").
pub const MAX_TURN_DEG: f64 = 140.0;

/// Returns the default number of context views of a captured scene, for a network that was trained with up to `trained`
/// views. With camera-relative attention it takes one for every fourth frame, up to three times as many as in training:
/// further views improve its renderings (models/rooms/README.md).
///
/// # Errors
/// Those of counting the frames.
pub fn default_num_context(
    model: &ModelConfig,
    trained: usize,
    source: &dyn SceneSource,
    scene: usize,
) -> Result<usize, DataError> {
    if model.camera_encoding == CameraEncoding::Plucker {
        return Ok(trained);
    }
    Ok((source.num_frames(scene)? / 4).clamp(trained, 3 * trained))
}

/// Chooses `num_views` context frames of a scene, or all its frames if it has fewer, at equal distances along the camera
/// path, as [`encode`](crate::encode) does without [`EncodeOptions::context`](crate::EncodeOptions::context).
///
/// # Errors
/// Those of the cameras, and [`CameraError::ZeroBaseline`](clift_core::CameraError::ZeroBaseline) for frames without a scale.
pub fn spread_contexts(reader: &ClipReader, scene: usize, num_views: usize) -> Result<Vec<usize>, SceneError> {
    let (context, _) = contexts(reader, scene, None, num_views)?;
    Ok(context)
}

/// Returns the context frames of a scene and the frame of its poses.
pub(crate) fn contexts(
    reader: &ClipReader,
    scene: usize,
    requested: Option<&[usize]>,
    num_views: usize,
) -> Result<(Vec<usize>, PoseNormalization), SceneError> {
    let (key, data) = (reader.source.key(scene), &reader.options);
    let poses: Vec<Pose> = reader.source.cameras(scene)?.iter().map(|camera| camera.c2w).collect();
    let frames = context_frames(&poses, requested, num_views)?;
    let context_poses: Vec<Pose> = frames.iter().map(|&frame| poses[frame]).collect();
    let normalization = PoseNormalization::find(key, &context_poses, &[], data.pose_rotation, data.pose_scale)
        .map_err(DataError::from)?;
    Ok((frames, normalization))
}

/// Checks the requested context frames, or chooses `num_views` frames along the camera path.
fn context_frames(poses: &[Pose], requested: Option<&[usize]>, num_views: usize) -> Result<Vec<usize>, SceneError> {
    let num_frames = poses.len();
    let bad = |value: String, fix: String| ModelError::BadConfig { key: "--context", value, fix }.into();
    let Some(requested) = requested else {
        return contexts_along_path(poses, num_views.min(num_frames)).ok_or_else(|| {
            bad(num_views.to_string(), format!("the scene has {num_frames} frames; list the frames to use"))
        });
    };
    let list = requested.iter().map(ToString::to_string).collect::<Vec<_>>().join(",");
    let mut sorted = requested.to_vec();
    sorted.sort_unstable();
    sorted.dedup();
    if requested.len() < 2 || sorted.len() < requested.len() {
        return Err(bad(list, "write at least two frames, each once".into()));
    }
    if let Some(frame) = requested.iter().find(|frame| **frame >= num_frames) {
        let last = num_frames.saturating_sub(1);
        return Err(bad(list, format!("there is no frame {frame}; the scene has frames 0 to {last}")));
    }
    Ok(requested.to_vec())
}

/// Returns the largest angle between the directions of two cameras, in degrees.
pub(crate) fn widest_turn_deg(cameras: &[Camera]) -> f64 {
    let axes: Vec<DVec3> = cameras.iter().map(|camera| camera.c2w.rotation.z_axis).collect();
    let least = axes.iter().flat_map(|a| axes.iter().map(|b| a.dot(*b))).fold(1.0, f64::min);
    least.max(-1.0).acos().to_degrees()
}

#[cfg(test)]
mod tests {
    use clift_core::{DMat3, Intrinsics};

    use super::*;

    #[test]
    fn context_frames_are_checked_or_spread() {
        let at = |x: f64| Pose { translation: [x, 0.0, 0.0].into(), ..Pose::IDENTITY };
        let poses: Vec<Pose> = (0..10).map(f64::from).map(at).collect();
        assert_eq!(context_frames(&poses, None, 4).unwrap(), [0, 3, 6, 9]);
        assert_eq!(context_frames(&poses[..3], None, 4).unwrap(), [0, 1, 2]);
        assert_eq!(context_frames(&poses, Some(&[7, 2]), 4).unwrap(), [7, 2]);
        let message = |frames: &[usize]| context_frames(&poses, Some(frames), 4).unwrap_err().to_string();
        assert_eq!(message(&[0, 10]), "`--context` = 0,10: there is no frame 10; the scene has frames 0 to 9");
        assert_eq!(message(&[3, 3]), "`--context` = 3,3: write at least two frames, each once");
        assert_eq!(message(&[3]), "`--context` = 3: write at least two frames, each once");
    }

    #[test]
    fn the_widest_turn_is_between_any_two_cameras() {
        let camera = |yaw_deg: f64| Camera {
            c2w: Pose { rotation: DMat3::from_rotation_y(yaw_deg.to_radians()), ..Pose::IDENTITY },
            intrinsics: Intrinsics { fx: 1.0, fy: 1.0, cx: 0.5, cy: 0.5 },
        };
        assert!((widest_turn_deg(&[camera(-30.0), camera(0.0), camera(120.0)]) - 150.0).abs() < 1e-9);
        assert!(widest_turn_deg(&[camera(20.0)]) < 1e-5);
    }
}
