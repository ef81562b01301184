//! Undoing lens distortion: a picture as a pinhole camera would have taken it.

use rayon::prelude::*;

use crate::camera::IntrinsicsNorm;
use crate::clip::Frame;
use crate::error::DataError;
use crate::lens::Lens;

/// Points of each edge of a picture that are followed through the lens.
const EDGE_POINTS: usize = 129;

/// A pinhole camera that sees part of what a distorted one does, and the way between their pixels.
///
/// Centre of projection, principal point and size stay. The focal lengths grow or shrink by one factor, the smallest
/// with which every pixel has one in the distorted picture: no blank corners, as OpenCV's `alpha = 0`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Undistortion {
    from: IntrinsicsNorm,
    lens: Lens,
    to: IntrinsicsNorm,
}

impl Undistortion {
    /// Finds the pinhole camera for pictures taken with `intrinsics_norm` through `lens`.
    ///
    /// # Errors
    /// [`DataError::BadCamera`] for a lens that cannot be undone at the edge of the picture, and for a principal point
    /// outside of the picture.
    pub fn new(intrinsics_norm: IntrinsicsNorm, lens: Lens) -> Result<Self, DataError> {
        lens.validate()?;
        let IntrinsicsNorm { fx, fy, cx, cy } = intrinsics_norm;
        let bad = |what: String| DataError::BadCamera { what };
        // Of the rays of each edge, the one nearest to the axis bounds the rectangle that is all picture.
        let [mut left, mut right, mut top, mut bottom] = [f64::INFINITY; 4];
        for step in 0..EDGE_POINTS {
            let share = step as f64 / (EDGE_POINTS - 1) as f64;
            let ray = |u: f64, v: f64| {
                lens.undistort([(u - cx) / fx, (v - cy) / fy]).ok_or_else(|| {
                    bad(format!("the lens distortion ({lens:?}) cannot be undone at the edge of the picture"))
                })
            };
            left = left.min(-ray(0.0, share)?[0]);
            right = right.min(ray(1.0, share)?[0]);
            top = top.min(-ray(share, 0.0)?[1]);
            bottom = bottom.min(ray(share, 1.0)?[1]);
        }
        if !(left.min(right).min(top).min(bottom) > 0.0) {
            return Err(bad(format!(
                "the principal point ({cx}, {cy}) of a distorted camera lies outside of the picture"
            )));
        }
        let needed = [cx / left / fx, (1.0 - cx) / right / fx, cy / top / fy, (1.0 - cy) / bottom / fy];
        let zoom = needed.into_iter().fold(0.0, f64::max);
        Ok(Self { from: intrinsics_norm, lens, to: IntrinsicsNorm { fx: fx * zoom, fy: fy * zoom, cx, cy } })
    }

    /// Intrinsics of the pinhole camera.
    pub fn intrinsics_norm(&self) -> IntrinsicsNorm {
        self.to
    }

    /// Resamples a picture, bilinearly, into one of the same size. What rounding puts beyond the edge is the edge.
    pub fn apply(&self, frame: &Frame) -> Frame {
        let &Frame { width, height, ref rgb } = frame;
        let (from, to) = (self.from.to_pixels(width, height), self.to.to_pixels(width, height));
        let mut undistorted = vec![0; rgb.len()];
        undistorted.par_chunks_exact_mut(width * 3).enumerate().for_each(|(row, pixels)| {
            let y = (row as f64 + 0.5 - to.cy) / to.fy;
            for (column, pixel) in pixels.as_chunks_mut().0.iter_mut().enumerate() {
                let x = (column as f64 + 0.5 - to.cx) / to.fx;
                let [x, y] = self.lens.distort([x, y]);
                *pixel = bilinear(frame, x * from.fx + from.cx, y * from.fy + from.cy);
            }
        });
        Frame { width, height, rgb: undistorted }
    }
}

/// Colour at `(x, y)`, with pixel centres at halves.
fn bilinear(frame: &Frame, x: f64, y: f64) -> [u8; 3] {
    let place = |at: f64, size: usize| {
        let at = (at - 0.5).clamp(0.0, (size - 1) as f64);
        let low = (at as usize).min(size - 1);
        (low, (low + 1).min(size - 1), (at - low as f64) as f32)
    };
    let (left, right, x) = place(x, frame.width);
    let (top, bottom, y) = place(y, frame.height);
    let pixel = |column: usize, row: usize| &frame.rgb[(row * frame.width + column) * 3..][..3];
    let corners = [pixel(left, top), pixel(right, top), pixel(left, bottom), pixel(right, bottom)];
    [0, 1, 2].map(|channel| {
        let [a, b, c, d] = corners.map(|corner| f32::from(corner[channel]));
        let (upper, lower) = (a + (b - a) * x, c + (d - c) * x);
        (upper + (lower - upper) * y + 0.5) as u8
    })
}
