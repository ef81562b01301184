//! Resampling of lens-distorted images to pinhole images.

use clift_core::{IntrinsicsNorm, RgbImage};
use rayon::prelude::*;

use crate::error::DataError;
use crate::geometry::lens::Lens;

/// Points of each image edge at which the lens is inverted.
const EDGE_POINTS: usize = 129;
/// Largest angle between the axis and an edge of the pinhole camera, in degrees. At 60, a pixel at the edge spans a
/// quarter of the angle of one at the centre.
const MAX_ANGLE_DEG: f64 = 60.0;
/// Largest factor of the focal lengths: a lens that leaves less than half of the columns is a wrong calibration.
const MAX_ZOOM: f64 = 2.0;

/// A pinhole camera within the view of a distorted camera, and the map between their pixels.
///
/// Camera centre, principal point and image size are equal. Both focal lengths are multiplied by the smallest factor
/// for which every pixel lies in the distorted image: no blank corners, as OpenCV's `alpha = 0`. The edges are at most
/// 60 degrees off the axis, and before the radius at which the distortion folds over.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Undistortion {
    from: IntrinsicsNorm,
    lens: Lens,
    to: IntrinsicsNorm,
    is_cut: bool,
}

impl Undistortion {
    /// Computes the pinhole camera for images taken with `intrinsics_norm` through `lens`.
    ///
    /// # Errors
    /// [`DataError::Camera`] for a lens that can be inverted in less than half of the image, and for a principal point
    /// outside the image.
    pub fn new(intrinsics_norm: IntrinsicsNorm, lens: Lens) -> Result<Self, DataError> {
        lens.validate()?;
        let IntrinsicsNorm { fx, fy, cx, cy } = intrinsics_norm;
        let bad = DataError::bad_camera;
        // The ray of each edge that is nearest to the axis bounds the rectangle without blank pixels.
        let [mut left, mut right, mut top, mut bottom] = [f64::INFINITY; 4];
        let mut has_all_rays = true;
        for step in 0..EDGE_POINTS {
            let share = step as f64 / (EDGE_POINTS - 1) as f64;
            for (u, v, extent, axis, sign) in [
                (0.0, share, &mut left, 0, -1.0),
                (1.0, share, &mut right, 0, 1.0),
                (share, 0.0, &mut top, 1, -1.0),
                (share, 1.0, &mut bottom, 1, 1.0),
            ] {
                match lens.undistort([(u - cx) / fx, (v - cy) / fy]) {
                    Some(ray) => *extent = extent.min(sign * ray[axis]),
                    None => has_all_rays = false,
                }
            }
        }
        let nearest = left.min(right).min(top).min(bottom);
        if nearest <= 0.0 || !(0.0..1.0).contains(&cx) || !(0.0..1.0).contains(&cy) {
            let what = format!("the principal point ({cx}, {cy}) of a distorted camera lies outside of the image");
            return Err(bad(what));
        }
        let limit = MAX_ANGLE_DEG.to_radians().tan();
        let is_cut = !has_all_rays || left.max(right).max(top).max(bottom) > limit;
        let [left, right, top, bottom] = [left, right, top, bottom].map(|extent| extent.min(limit));
        let needed = [cx / left / fx, (1.0 - cx) / right / fx, cy / top / fy, (1.0 - cy) / bottom / fy];
        let zoom = needed.into_iter().fold(0.0, f64::max);
        let zoomed = |zoom: f64| {
            let to = IntrinsicsNorm { fx: fx * zoom, fy: fy * zoom, cx, cy };
            Self { from: intrinsics_norm, lens, to, is_cut }
        };
        if has_all_rays || zoomed(zoom).is_within_lens() {
            return Ok(zoomed(zoom));
        }
        let [mut below, mut above] = [zoom, MAX_ZOOM * zoom.max(1.0)];
        if !zoomed(above).is_within_lens() {
            return Err(bad(format!("the lens distortion ({lens:?}) cannot be undone at the edge of the image")));
        }
        while above / below > 1.0 + 1e-6 {
            let middle = f64::midpoint(below, above);
            *(if zoomed(middle).is_within_lens() { &mut above } else { &mut below }) = middle;
        }
        Ok(zoomed(above))
    }

    /// Returns whether the lens can be inverted at the edge of the pinhole image, within the distorted image.
    fn is_within_lens(&self) -> bool {
        let IntrinsicsNorm { fx, fy, cx, cy } = self.from;
        let is_seen = |u: f64, v: f64| {
            let ray = [(u - self.to.cx) / self.to.fx, (v - self.to.cy) / self.to.fy];
            let [x, y] = self.lens.distort(ray);
            let is_inside = |at: f64| (-1e-9..=1.0 + 1e-9).contains(&at);
            is_inside(x * fx + cx) && is_inside(y * fy + cy) && self.lens.is_invertible_at(ray)
        };
        (0..EDGE_POINTS).all(|step| {
            let share = step as f64 / (EDGE_POINTS - 1) as f64;
            is_seen(0.0, share) && is_seen(1.0, share) && is_seen(share, 0.0) && is_seen(share, 1.0)
        })
    }

    /// Returns whether the lens sees more, along an edge, than the pinhole camera can hold: 120 degrees, or the part
    /// before the fold.
    pub fn is_cut(&self) -> bool {
        self.is_cut
    }

    /// Returns the intrinsics of the pinhole camera.
    pub fn intrinsics_norm(&self) -> IntrinsicsNorm {
        self.to
    }

    /// Resamples an image bilinearly to the same size. Positions beyond the edge by rounding are clamped to the edge.
    pub fn apply(&self, image: &RgbImage) -> RgbImage {
        let &RgbImage { width, height, ref rgb } = image;
        let mut undistorted = vec![0; rgb.len()];
        let rows = undistorted.par_chunks_exact_mut(width * 3).enumerate();
        // Positions first, colours second: the compiler vectorises only the loop without memory access.
        rows.for_each_init(
            || vec![[0; 2]; width],
            |positions, (row, pixels)| {
                self.find_positions(row, [width, height], positions);
                for (pixel, position) in pixels.as_chunks_mut().0.iter_mut().zip(&*positions) {
                    *pixel = bilinear(image, *position);
                }
            },
        );
        RgbImage { width, height, rgb: undistorted }
    }

    /// Computes the position of each pixel of a row in the distorted image, clamped to the image: column and row from
    /// the centre of the first pixel, in units of 1 / [`STEPS`] pixel.
    fn find_positions(&self, row: usize, size: [usize; 2], positions: &mut [[u32; 2]]) {
        // The compiler vectorises the first loop, six times as fast as the second.
        if self.lens.is_opencv() {
            self.find_positions_by(|ray| self.lens.distort_opencv(ray), row, size, positions);
        } else {
            self.find_positions_by(|ray| self.lens.distort(ray), row, size, positions);
        }
    }

    fn find_positions_by(
        &self,
        distort: impl Fn([f64; 2]) -> [f64; 2],
        row: usize,
        [width, height]: [usize; 2],
        positions: &mut [[u32; 2]],
    ) {
        let (from, to) = (self.from.to_pixels(width, height), self.to.to_pixels(width, height));
        let (step_x, y) = (1.0 / to.fx, (row as f64 + 0.5 - to.cy) / to.fy);
        let most = [width, height].map(|side| ((side - 1) * STEPS) as f64);
        let steps = STEPS as f64;
        for (column, position) in positions.iter_mut().enumerate() {
            let x = (f64::from(column as u32) + 0.5 - to.cx) * step_x;
            let [x, y] = distort([x, y]);
            let at = [(x * from.fx + from.cx - 0.5) * steps + 0.5, (y * from.fy + from.cy - 0.5) * steps + 0.5];
            *position = [at[0].clamp(0.0, most[0]) as u32, at[1].clamp(0.0, most[1]) as u32];
        }
    }
}

/// Steps per pixel of a position. The product of two positions within a pixel and a colour fits into 32 bits.
const STEPS: usize = 2048;

/// Interpolates the colour at a position in units of 1 / [`STEPS`] pixel bilinearly.
fn bilinear(image: &RgbImage, position: [u32; 2]) -> [u8; 3] {
    let steps = STEPS as u32;
    let [column, row] = position.map(|at| (at / steps) as usize);
    let [x, y] = position.map(|at| at % steps);
    let right = (column + 1).min(image.width - 1);
    let below = (row + 1).min(image.height - 1);
    let pixel = |column: usize, row: usize| {
        let start = (row * image.width + column) * 3;
        &image.rgb[start..start + 3]
    };
    let (a, b, c, d) = (pixel(column, row), pixel(right, row), pixel(column, below), pixel(right, below));
    [0, 1, 2].map(|channel| {
        let [a, b, c, d] = [a, b, c, d].map(|pixel| u32::from(pixel[channel]));
        let (upper, lower) = (a * (steps - x) + b * x, c * (steps - x) + d * x);
        ((upper * (steps - y) + lower * y + steps * steps / 2) / (steps * steps)) as u8
    })
}
