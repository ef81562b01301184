//! Corners seen in three frames: two of the frames place a point, which the third must show where its corner is.
//!
//! Epipolar lines leave one direction free. A third frame does not: exchanged neighbours of a straight camera path have
//! the same epipolar lines, but show other depths.

use std::collections::HashMap;

use clift_core::median;
use glam::DVec3;

use crate::tools::check::matches::{FramePair, subsample};
use crate::tools::features::pixel_camera::PixelCamera;

/// Largest number of triplets of a frame.
const MAX_TRIPLETS: usize = 6;
/// Smallest number of corners of a triplet.
const MIN_CORNERS: usize = 15;
/// Largest number of corners of a triplet that are evaluated.
const MAX_CORNERS: usize = 150;
/// Frames to the nearer of the two others above which a larger gap is no longer preferred.
const ENOUGH_GAP: usize = 4;

/// A frame, two others, and the corners that all three show.
pub(crate) struct Triplet {
    /// The frame that is judged.
    pub frame: usize,
    /// The frames that place the points.
    pub others: [usize; 2],
    /// Corners in the others and in the frame.
    corners: Vec<[[f64; 2]; 3]>,
}

impl Triplet {
    /// Returns the median distance of the corners from where the others place them, in pixels.
    pub fn reprojection_px(&self, cameras: &[PixelCamera]) -> f64 {
        let [first, second] = self.others.map(|frame| &cameras[frame]);
        let judged = &cameras[self.frame];
        let distance = |[a, b, seen]: &[[f64; 2]; 3]| {
            let [x, y] = transferred(first, *a, second, *b, judged)?;
            Some((x - seen[0]).hypot(y - seen[1]))
        };
        // A point that cannot be projected is as far away as it can be.
        let distances = self.corners.iter().map(|corners| distance(corners).unwrap_or(f64::INFINITY));
        median(&distances.collect::<Vec<f64>>())
    }
}

/// A frame that matches another, with its corners by the bits of the corners of the other, which are equal in every pair.
type Partner = (usize, HashMap<[u64; 2], [f64; 2]>);

/// Selects for each frame the triplets with many corners and wide gaps, best first.
pub(crate) fn find_triplets(num_frames: usize, pairs: &[FramePair]) -> Vec<Vec<Triplet>> {
    let mut partners: Vec<Vec<Partner>> = (0..num_frames).map(|_| Vec::new()).collect();
    let bits = |corner: [f64; 2]| corner.map(f64::to_bits);
    for FramePair { frames: [first, second], matches } in pairs {
        let forward = matches.iter().map(|pair| (bits(pair.first), pair.second)).collect();
        let backward = matches.iter().map(|pair| (bits(pair.second), pair.first)).collect();
        partners[*first].push((*second, forward));
        partners[*second].push((*first, backward));
    }
    let of_frame = |(frame, partners): (usize, Vec<Partner>)| {
        let mut triplets = Vec::new();
        for (position, (a, in_a)) in partners.iter().enumerate() {
            for (b, in_b) in &partners[position + 1..] {
                let common = in_a
                    .iter()
                    .filter_map(|(seen, corner)| Some([*corner, *in_b.get(seen)?, seen.map(f64::from_bits)]));
                let mut corners: Vec<[[f64; 2]; 3]> = common.collect();
                if corners.len() < MIN_CORNERS {
                    continue;
                }
                corners.sort_by(|p, q| p[2][0].total_cmp(&q[2][0]).then(p[2][1].total_cmp(&q[2][1])));
                let gap = a.abs_diff(frame).min(b.abs_diff(frame));
                let is_between = (*a < frame) != (*b < frame);
                let weight = corners.len() * (gap + 2 * usize::from(is_between)).min(ENOUGH_GAP);
                let corners = subsample(&corners, MAX_CORNERS).collect();
                triplets.push((weight, Triplet { frame, others: [*a, *b], corners }));
            }
        }
        triplets.sort_by_key(|(weight, triplet)| (std::cmp::Reverse(*weight), triplet.others));
        triplets.into_iter().take(MAX_TRIPLETS).map(|(_, triplet)| triplet).collect()
    };
    partners.into_iter().enumerate().map(of_frame).collect()
}

/// Places a point by its corners `a` and `b` in two frames, and projects it into a third. A point at infinity is
/// projected too. Returns `None` for a point in the plane of the third camera.
fn transferred(
    first: &PixelCamera,
    a: [f64; 2],
    second: &PixelCamera,
    b: [f64; 2],
    third: &PixelCamera,
) -> Option<[f64; 2]> {
    let ray = first.ray(a);
    // Homogeneous pixels of the point with inverse depth `s` on the ray are `direction + s * origin`.
    let along = |camera: &PixelCamera| [camera.project_direction(ray), camera.project(first.c2w.translation)];
    let [direction, origin] = along(second);
    let residual = |pixel: DVec3| [b[0] * pixel.z - pixel.x, b[1] * pixel.z - pixel.y];
    let (offset, slope) = (residual(direction), residual(origin));
    let square = slope[0] * slope[0] + slope[1] * slope[1];
    let s = if square > 0.0 { -(offset[0] * slope[0] + offset[1] * slope[1]) / square } else { 0.0 };
    let [direction, origin] = along(third);
    let pixel = direction + s * origin;
    let seen = [pixel.x / pixel.z, pixel.y / pixel.z];
    seen.iter().all(|value| value.is_finite()).then_some(seen)
}

#[cfg(test)]
mod tests {
    use super::*;
    use clift_core::{Camera, IntrinsicsNorm, Pose};
    use glam::DMat3;

    #[test]
    fn point_is_placed_where_the_third_camera_sees_it() {
        let intrinsics_norm = IntrinsicsNorm { fx: 0.9, fy: 1.2, cx: 0.5, cy: 0.48 };
        let camera = |x: f64, angle: f64| {
            let c2w = Pose { rotation: DMat3::from_rotation_y(angle), translation: DVec3::new(x, 0.1 * x, 0.0) };
            PixelCamera::new(&Camera { intrinsics: intrinsics_norm, c2w }, [320, 240])
        };
        let cameras = [camera(0.0, 0.1), camera(0.4, 0.0), camera(1.0, -0.2)];
        for point in [DVec3::new(0.3, -0.2, 4.0), DVec3::new(-30.0, 200.0, 1e9)] {
            let [a, b, c] = cameras.each_ref().map(|camera| {
                let pixel = camera.project(point);
                [pixel.x / pixel.z, pixel.y / pixel.z]
            });
            let seen = transferred(&cameras[0], a, &cameras[1], b, &cameras[2]).unwrap();
            assert!((seen[0] - c[0]).hypot(seen[1] - c[1]) < 1e-3, "{seen:?} {c:?}");
        }
    }
}
