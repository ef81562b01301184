//! View overlap of two cameras from poses alone.

use glam::DVec3;

use crate::geometry::camera::Camera;
use crate::geometry::pose::Pose;

/// Rays along a side of the image.
const SIDE: usize = 32;

/// Share in `[0, 1]` of `from`'s image that `to` may see: of a grid of 32 x 32 rays, those with any point in front of
/// `from` that projects into the image of `to`. pixelSplat's measure, which needs no depth: the epipolar line of the
/// ray crosses the other image. An upper bound of the true overlap.
pub fn overlap(from: &Camera, to: &Camera) -> f64 {
    let motion = to.c2w.inverse().after(from.c2w);
    let place = |index: usize| (index as f64 + 0.5) / SIDE as f64;
    let rays = (0..SIDE * SIDE).map(|ray| [place(ray % SIDE), place(ray / SIDE)]);
    let seen = rays.filter(|[u, v]| {
        let k = from.intrinsics_norm;
        is_seen(motion, DVec3::new((u - k.cx) / k.fx, (v - k.cy) / k.fy, 1.0), to)
    });
    seen.count() as f64 / (SIDE * SIDE) as f64
}

/// Whether any point at `t > 0` of the ray from the origin, moved by `motion`, lies in the camera's view: four planes
/// through the camera's centre, each a linear condition on `t`.
fn is_seen(motion: Pose, direction: DVec3, to: &Camera) -> bool {
    let k = to.intrinsics_norm;
    let inside = |DVec3 { x, y, z }: DVec3| {
        [k.fx * x + k.cx * z, (1.0 - k.cx) * z - k.fx * x, k.fy * y + k.cy * z, (1.0 - k.cy) * z - k.fy * y]
    };
    let (start, slope) = (inside(motion.translation), inside(motion.rotation * direction));
    let (mut low, mut high) = (0.0_f64, f64::INFINITY);
    for (a, b) in start.into_iter().zip(slope) {
        if b > 0.0 {
            low = low.max(-a / b);
        } else if b < 0.0 {
            high = high.min(-a / b);
        } else if a < 0.0 {
            return false;
        }
    }
    low < high
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;
    use crate::geometry::camera::IntrinsicsNorm;
    use crate::random::{step_rng, unit};

    fn camera(turn_deg: f64, centre: [f64; 3]) -> Camera {
        let rotation = DMat3::from_rotation_y(turn_deg.to_radians());
        let intrinsics_norm = IntrinsicsNorm { fx: 0.5, fy: 0.5, cx: 0.5, cy: 0.5 }; // 90 degrees
        Camera { intrinsics_norm, c2w: Pose { rotation, translation: centre.into() } }
    }

    #[test]
    fn the_same_camera_overlaps_wholly_and_the_opposite_one_not_at_all() {
        let here = camera(0.0, [0.0; 3]);
        assert_eq!(overlap(&here, &here), 1.0);
        assert_eq!(overlap(&here, &camera(180.0, [0.0; 3])), 0.0);
        assert_eq!(overlap(&here, &camera(90.0, [0.0; 3])), 0.0);
        // From behind everything is seen, at a distance; from in front what is ahead.
        assert_eq!(overlap(&here, &camera(0.0, [0.0, 0.0, -3.0])), 1.0);
        assert_eq!(overlap(&here, &camera(0.0, [0.0, 0.0, 3.0])), 1.0);
        // Face to face, each sees what is between the two: along every ray there is a stretch, seen from 3 ahead.
        assert_eq!(overlap(&here, &camera(180.0, [0.0, 0.0, 3.0])), 1.0);
    }

    #[test]
    fn turning_on_the_spot_by_half_the_view_leaves_half_of_the_angle() {
        // Of a view from -45 to 45 degrees the other sees 0 to 90: columns whose tangent is 0 to 1, half of them. Rows:
        // a ray at 10 degrees of turn and the same height is at the edge of the other's rows or outside of them.
        let share = overlap(&camera(0.0, [0.0; 3]), &camera(45.0, [0.0; 3]));
        assert!((0.35..0.5).contains(&share), "{share}");
        assert_eq!(share, overlap(&camera(0.0, [0.0; 3]), &camera(-45.0, [0.0; 3])));
    }

    #[test]
    fn a_ray_is_seen_where_trying_many_depths_finds_it_seen() {
        let (mut num_seen, mut num_missed) = (0, 0);
        for i in 0..2000 {
            let mut rng = step_rng(3, i, "test");
            let mut around = |size: f64| (2.0 * unit(&mut rng) - 1.0) * size;
            let to = camera(around(90.0), [around(2.0), around(2.0), around(2.0)]);
            let direction = DVec3::new(around(1.0), around(1.0), 1.0);
            let motion = to.c2w.inverse();
            let tried = (0..4000).map(|step| 1e-3 * 1.005_f64.powi(step)).any(|t| {
                let [x, y, z] = motion.apply(direction * t).to_array();
                z > 0.0 && (0.5 * x / z).abs() < 0.5 && (0.5 * y / z).abs() < 0.5
            });
            let seen = is_seen(motion, direction, &to);
            assert!(seen || !tried, "{i}");
            num_seen += usize::from(seen);
            num_missed += usize::from(seen && !tried);
        }
        // What is seen over a sliver of depths only may be missed by trying.
        assert!((300..1700).contains(&num_seen) && num_missed < 20, "{num_missed} of {num_seen}");
    }
}
