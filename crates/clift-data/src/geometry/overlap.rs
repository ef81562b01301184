//! View overlap of two cameras, from poses and intrinsics alone.

use clift_core::{Camera, IntrinsicsNorm, Pose};
use glam::DVec3;

const SIDE: usize = 32;

/// Returns the share in `[0, 1]` of the image of `from` that `to` may see: the rays of a 32 x 32 grid with any point in
/// front of `from` that projects into the image of `to`.
///
/// pixelSplat's measure. It needs no depth and is an upper bound of the true overlap.
pub fn overlap(from: &Camera<IntrinsicsNorm>, to: &Camera<IntrinsicsNorm>) -> f64 {
    let motion = to.c2w.inverse().after(from.c2w);
    let coordinate = |index: usize| (index as f64 + 0.5) / SIDE as f64;
    let rays = (0..SIDE * SIDE).map(|ray| [coordinate(ray % SIDE), coordinate(ray / SIDE)]);
    let seen = rays.filter(|[u, v]| {
        let k = from.intrinsics;
        is_seen(motion, DVec3::new((u - k.cx) / k.fx, (v - k.cy) / k.fy, 1.0), to)
    });
    seen.count() as f64 / (SIDE * SIDE) as f64
}

/// Returns whether any point at `t > 0` of the ray from the origin, moved by `motion`, lies in the view of `to`. The
/// view is bounded by four planes through the camera centre, each a linear condition on `t`.
fn is_seen(motion: Pose, direction: DVec3, to: &Camera<IntrinsicsNorm>) -> bool {
    let k = to.intrinsics;
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
    use super::*;
    use glam::DMat3;

    fn camera(turn_deg: f64, centre: [f64; 3]) -> Camera<IntrinsicsNorm> {
        let rotation = DMat3::from_rotation_y(turn_deg.to_radians());
        let intrinsics_norm = IntrinsicsNorm { fx: 0.5, fy: 0.5, cx: 0.5, cy: 0.5 }; // 90 degrees
        Camera { intrinsics: intrinsics_norm, c2w: Pose { rotation, translation: centre.into() } }
    }

    #[test]
    fn overlap_of_equal_opposite_and_shifted_cameras() {
        let here = camera(0.0, [0.0; 3]);
        assert_eq!(overlap(&here, &here), 1.0);
        assert_eq!(overlap(&here, &camera(180.0, [0.0; 3])), 0.0);
        assert_eq!(overlap(&here, &camera(90.0, [0.0; 3])), 0.0);
        // Every ray is seen at some distance, from behind and from in front.
        assert_eq!(overlap(&here, &camera(0.0, [0.0, 0.0, -3.0])), 1.0);
        assert_eq!(overlap(&here, &camera(0.0, [0.0, 0.0, 3.0])), 1.0);
        // Face to face: a part of every ray lies between the cameras.
        assert_eq!(overlap(&here, &camera(180.0, [0.0, 0.0, 3.0])), 1.0);
        // A camera turned by 45 degrees sees half of the columns, and in these not all rows.
        let share = overlap(&here, &camera(45.0, [0.0; 3]));
        assert!((0.35..0.5).contains(&share), "{share}");
        assert_eq!(share, overlap(&here, &camera(-45.0, [0.0; 3])));
    }
}
