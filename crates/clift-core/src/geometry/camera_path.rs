//! Camera paths for rendering: through the context views, or an orbit around their focus.

use glam::{DMat3, DVec3};

use crate::geometry::camera::{Camera, Intrinsics};
use crate::geometry::pose::Pose;

/// Radius of an orbit over the extent of the context centres; farther out the contexts show little.
const ORBIT_SHARE: f64 = 0.7;
/// Smallest radius of an orbit, for contexts on a line. Normalised contexts reach to 1.
const MIN_ORBIT_RADIUS: f64 = 0.1;
/// Distance of an orbit's focus for contexts with parallel axes.
const FOCUS: f64 = 2.0;
/// Bounds of the distance otherwise.
const FOCUS_RANGE: [f64; 2] = [0.5, 8.0];

/// Returns a smooth path through all context views in their order, from the first view to the last.
///
/// Centres follow a Catmull-Rom spline. Orientations are interpolated spherically, intrinsics linearly.
pub fn interpolate_path(context: &[Camera], num_frames: usize) -> Vec<Camera> {
    let Some(last) = context.len().checked_sub(1) else { return Vec::new() };
    let time = |frame: usize| last as f64 * frame as f64 / num_frames.saturating_sub(1).max(1) as f64;
    (0..num_frames).map(|frame| view_at(context, time(frame))).collect()
}

/// Interpolates the view at `time` in `[0, context.len() - 1]`.
fn view_at(context: &[Camera], time: f64) -> Camera {
    let last = context.len() - 1;
    let first = (time as usize).min(last.saturating_sub(1));
    let t = time - first as f64;
    let [before, from, to, after] =
        [first.saturating_sub(1), first, (first + 1).min(last), (first + 2).min(last)].map(|view| &context[view]);
    let [a, b, c, d] = [before, from, to, after].map(|view| view.c2w.translation);
    let translation = b + 0.5 * t * (c - a + t * (2.0 * a - 5.0 * b + 4.0 * c - d + t * (3.0 * (b - c) + d - a)));
    let rotation = DMat3::from_quat(from.c2w.quaternion().slerp(to.c2w.quaternion(), t).normalize());
    let [a, b] = [from, to].map(|view| view.intrinsics.to_array());
    let intrinsics = [0, 1, 2, 3].map(|i| a[i] + t * (b[i] - a[i])).into();
    Camera { c2w: Pose { rotation, translation }, intrinsics }
}

/// Returns a closed ellipse around the mean view that faces the focus of the context views. The radii are 0.7 of the
/// extent of the context centres. A frame after the last would equal the first.
pub fn orbit_path(context: &[Camera], num_frames: usize) -> Vec<Camera> {
    let Some(intrinsics) = mean_intrinsics(context) else { return Vec::new() };
    let focus = focus_distance(context) * DVec3::Z;
    let extent = context.iter().fold(DVec3::ZERO, |extent, view| extent.max(view.c2w.translation.abs()));
    let radius = (ORBIT_SHARE * extent).max(DVec3::splat(MIN_ORBIT_RADIUS));
    let view = |frame: usize| {
        let (sin, cos) = (std::f64::consts::TAU * frame as f64 / num_frames as f64).sin_cos();
        Camera { c2w: look_at(radius * DVec3::new(cos, sin, 0.0), focus), intrinsics }
    };
    (0..num_frames).map(view).collect()
}

/// Returns the mean intrinsics of the context views, `None` for no views.
pub fn mean_intrinsics(context: &[Camera]) -> Option<Intrinsics> {
    let count = context.len() as f64;
    let mean = |i: usize| context.iter().map(|view| view.intrinsics.to_array()[i] / count).sum::<f64>();
    (!context.is_empty()).then(|| [0, 1, 2, 3].map(mean).into())
}

/// Returns the distance along the mean view's axis of the point nearest to the axes of all views (least squares).
pub fn focus_distance(context: &[Camera]) -> f64 {
    let (mut numerator, mut denominator) = (0.0, 0.0);
    for view in context {
        let axis = view.c2w.rotation.z_axis;
        // With A = I - d d^T: z = sum(e^T A o) / sum(e^T A e).
        numerator += view.c2w.translation.z - axis.z * axis.dot(view.c2w.translation);
        denominator += 1.0 - axis.z * axis.z;
    }
    let distance = numerator / denominator;
    // Parallel axes do not meet, diverging ones meet behind the cameras.
    if denominator > 1e-6 && distance > 0.0 { distance.clamp(FOCUS_RANGE[0], FOCUS_RANGE[1]) } else { FOCUS }
}

/// Returns a camera at `centre` that looks at `point`, upright in the frame of the mean view.
fn look_at(centre: DVec3, point: DVec3) -> Pose {
    let forward = (point - centre).normalize();
    let right = DVec3::Y.cross(forward).normalize();
    Pose { rotation: DMat3::from_cols(right, forward.cross(right), forward), translation: centre }
}

#[cfg(test)]
mod tests {
    use super::*;

    const K: Intrinsics = Intrinsics { fx: 40.0, fy: 41.0, cx: 16.0, cy: 12.0 };

    fn view(centre: [f64; 3], angle: f64) -> Camera {
        Camera { c2w: Pose { rotation: DMat3::from_rotation_y(angle), translation: centre.into() }, intrinsics: K }
    }

    fn assert_close(a: &Camera, b: &Camera, tolerance: f64) {
        let (a, b) = (a.c2w.to_matrix_f64(), b.c2w.to_matrix_f64());
        assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < tolerance), "{a:?} {b:?}");
    }

    #[test]
    fn interpolated_path_passes_every_context_view() {
        let context = [
            view([-1.0, 0.0, 0.0], 0.4),
            view([-0.2, 0.1, 0.3], 0.1),
            view([0.3, -0.1, 0.0], 0.0),
            view([1.0, 0.0, 0.1], -0.5),
        ];
        let path = interpolate_path(&context, 31);
        for (i, view) in context.iter().enumerate() {
            assert_close(&path[10 * i], view, 1e-12);
        }
        assert!(path.iter().all(|view| view.c2w.orthonormality_defect() < 1e-12));
        // No step is longer than a few times the mean step.
        let step = |pair: &[Camera]| pair[0].c2w.translation.distance(pair[1].c2w.translation);
        assert!(path.windows(2).all(|pair| step(pair) < 0.2), "2 units in 30 steps");
    }

    #[test]
    fn midpoint_has_half_the_turn_and_mean_intrinsics() {
        let mut context = vec![view([0.0; 3], 0.2), view([1.0, 2.0, 0.0], 0.8)];
        context[1].intrinsics.fx = 60.0;
        let middle = interpolate_path(&context, 3)[1];
        assert_close(&middle, &view([0.5, 1.0, 0.0], 0.5), 1e-12);
        assert!((middle.intrinsics.fx - 50.0).abs() < 1e-12);
        assert_eq!(interpolate_path(&context, 1).len(), 1);
        assert_close(&interpolate_path(&context, 1)[0], &context[0], 1e-12);
        assert_close(&interpolate_path(&context[..1], 5)[3], &context[0], 1e-12);
        assert!(interpolate_path(&[], 5).is_empty());
    }

    #[test]
    fn orbit_faces_the_focus_of_the_contexts() {
        // Two cameras that look at (0, 0, 3) from either side.
        let turn = 1.0_f64.atan2(3.0);
        let context = [view([-1.0, 0.0, 0.0], turn), view([1.0, 0.0, 0.0], -turn)];
        assert!((focus_distance(&context) - 3.0).abs() < 1e-9);
        let path = orbit_path(&context, 12);
        for view in &path {
            let to_focus = 3.0 * DVec3::Z - view.c2w.translation;
            assert!((view.c2w.rotation.z_axis.dot(to_focus.normalize()) - 1.0).abs() < 1e-12);
            assert!(view.c2w.orthonormality_defect() < 1e-12);
            assert!(view.c2w.rotation.y_axis.y > 0.9, "upright");
        }
        assert!((path[0].c2w.translation.x - 0.7).abs() < 1e-12);
        assert!((path[3].c2w.translation.y - 0.1).abs() < 1e-12, "smallest radius for contexts on a line");
        assert_eq!(focus_distance(&[view([-1.0, 0.0, 0.0], 0.0), view([1.0, 0.0, 0.0], 0.0)]), FOCUS, "parallel axes");
        assert!(orbit_path(&[], 3).is_empty());
    }
}
