//! Baselines: the nearest context view, and the mean of all context views.

use clift_core::{Camera, ClipViews, Pose};

use crate::error::SceneError;

/// Tolerance of a tie, relative to the largest distance or in radians. Rounding must not decide between cameras that
/// rotate in place.
const TIE: f64 = 1e-9;

/// Finds the nearest camera centre. Ties go to the smaller rotation angle, then to the lower index.
pub fn nearest_view(context: &[Camera], target: Pose) -> Result<usize, SceneError> {
    let distances: Vec<f64> =
        context.iter().map(|camera| camera.c2w.translation.distance(target.translation)).collect();
    let nearest = distances.iter().copied().reduce(f64::min).ok_or(SceneError::NoContext)?;
    let tie = TIE * distances.iter().copied().fold(0.0, f64::max);
    let near: Vec<usize> = (0..distances.len()).filter(|&i| distances[i] <= nearest + tie).collect();
    let angles: Vec<f64> = near.iter().map(|&i| context[i].c2w.angle_to(target)).collect();
    let smallest = angles.iter().copied().fold(f64::INFINITY, f64::min);
    let first = angles.iter().position(|&angle| angle <= smallest + TIE).ok_or(SceneError::NoContext)?;
    Ok(near[first])
}

/// Returns the image of a view, `[height, width, 3]` in `[0, 1]`.
pub fn view_image(views: &ClipViews, view: usize) -> Vec<f32> {
    let len = views.height * views.width * 3;
    views.images[view * len..][..len].iter().map(|&value| f32::from(value) / 255.0).collect()
}

/// Returns the image of the nearest context view, `[height, width, 3]` in [0, 1].
pub fn nearest_image(context: &ClipViews, target: Pose) -> Result<Vec<f32>, SceneError> {
    Ok(view_image(context, nearest_view(&context.cameras, target)?))
}

/// Returns the mean of the context images, `[height, width, 3]` in [0, 1].
pub fn mean_image(context: &ClipViews) -> Result<Vec<f32>, SceneError> {
    if context.num_views() == 0 {
        return Err(SceneError::NoContext);
    }
    let mut sums = vec![0_u32; context.height * context.width * 3];
    for image in context.images.chunks_exact(sums.len()) {
        for (sum, &value) in sums.iter_mut().zip(image) {
            *sum += u32::from(value);
        }
    }
    let scale = 255.0 * context.num_views() as f64;
    Ok(sums.into_iter().map(|sum| (f64::from(sum) / scale) as f32).collect())
}

#[cfg(test)]
mod tests {
    use clift_core::{DMat3, DVec3, Intrinsics};

    use super::*;

    fn pose(x: f64, yaw_deg: f64) -> Pose {
        Pose { rotation: DMat3::from_rotation_y(yaw_deg.to_radians()), translation: x * DVec3::X }
    }

    fn views(poses: &[Pose], images: Vec<u8>) -> ClipViews {
        let intrinsics = Intrinsics { fx: 16.0, fy: 16.0, cx: 8.0, cy: 8.0 };
        let cameras = poses.iter().map(|&c2w| Camera { c2w, intrinsics }).collect();
        ClipViews { width: 1, height: 1, images, cameras, frame_index: (0..poses.len()).collect() }
    }

    #[test]
    fn distance_decides_then_angle_then_index() {
        for (context, target, expected, case) in [
            ([pose(1.0, 0.0), pose(0.5, 90.0)], pose(0.0, 0.0), 1, "distance before angle"),
            ([pose(1.0, 40.0), pose(-1.0, 5.0)], pose(0.0, 10.0), 1, "angle at equal distance"),
            ([pose(1.0, 20.0), pose(-1.0, 0.0)], pose(0.0, 10.0), 0, "index at equal angle"),
            ([pose(1.0 - 1e-14, 90.0), pose(1.0, 1.0)], pose(0.0, 0.0), 1, "a rounding difference is a tie"),
        ] {
            assert_eq!(nearest_view(&views(&context, Vec::new()).cameras, target).unwrap(), expected, "{case}");
        }
    }

    #[test]
    fn rotation_angles_are_exact() {
        for angle_deg in [0.0, 1e-6, 30.0, 90.0, 150.0, 180.0] {
            let angle = pose(0.0, 0.0).angle_to(pose(0.0, angle_deg)).to_degrees();
            // Products of sines and cosines near 1 round at 1e-16; 1e-12 degrees is above that.
            assert!((angle - angle_deg).abs() < 1e-12, "{angle} is not {angle_deg}");
        }
    }

    #[test]
    fn baseline_images_are_the_mean_and_a_copy() {
        let context = views(&[pose(0.0, 0.0), pose(1.0, 0.0)], vec![0, 51, 255, 255, 102, 255]);
        assert_eq!(mean_image(&context).unwrap(), [0.5, 0.3, 1.0]);
        assert_eq!(nearest_image(&context, pose(0.9, 0.0)).unwrap(), [1.0, 0.4, 1.0]);
        let empty = views(&[], Vec::new());
        assert!(matches!(mean_image(&empty), Err(SceneError::NoContext)));
        assert!(matches!(nearest_image(&empty, Pose::IDENTITY), Err(SceneError::NoContext)));
    }
}
