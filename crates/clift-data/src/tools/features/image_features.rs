//! Corners of an image, matched with another image without cameras: the reference for checking poses.
//!
//! Corners are found in two sizes of an image, described by the surrounding gradients, matched in both directions, and
//! kept if they agree with one fundamental matrix.

use clift_core::RgbImage;

use crate::image::lanczos::resize_lanczos;
use crate::tools::features::corners::{GrayImage, find_corners};
use crate::tools::features::descriptor::{Descriptor, match_mutually};
use crate::tools::features::epipolar::{Correspondence, WIDTH, ransac_inliers};

const MAX_CORNERS: [usize; 2] = [900, 500];
/// Size of the smaller image over the larger. Its corners match surfaces that the other image shows from farther away.
const SMALLER: f64 = 0.6;

/// Corners of an image, in pixels of the image [`WIDTH`] columns wide, and their descriptors.
#[derive(Clone, Debug, Default)]
pub struct Features {
    points: Vec<[f64; 2]>,
    descriptors: Vec<Descriptor>,
}

impl Features {
    pub fn detect(image: &RgbImage) -> Self {
        // At most `WIDTH` columns.
        let large = if image.width > WIDTH {
            let height = (image.height as f64 * WIDTH as f64 / image.width as f64).round().max(1.0) as usize;
            resize_lanczos(image, WIDTH, height)
        } else {
            image.clone()
        };
        let unit = WIDTH as f64 / large.width as f64;
        let smaller = |side: usize| ((side as f64 * SMALLER).round() as usize).max(1);
        let small = resize_lanczos(&large, smaller(large.width), smaller(large.height));
        let mut features = Self::default();
        for (image, count) in [&large, &small].into_iter().zip(MAX_CORNERS) {
            let gray = GrayImage::new(image).blurred();
            let (scale_x, scale_y) =
                (large.width as f64 / image.width as f64 * unit, large.height as f64 / image.height as f64 * unit);
            for [x, y] in find_corners(&gray, count) {
                if let Some(descriptor) = Descriptor::at(&gray, x, y) {
                    features.points.push([x * scale_x, y * scale_y]);
                    features.descriptors.push(descriptor);
                }
            }
        }
        features
    }

    /// Returns the pairs of mutually most similar corners that agree with one epipolar geometry. Deterministic; empty if
    /// too few pairs agree, as for images of different scenes.
    pub fn matches(&self, other: &Self) -> Vec<Correspondence> {
        let pairs = match_mutually(&self.descriptors, &other.descriptors);
        let matches: Vec<Correspondence> =
            pairs.into_iter().map(|(a, b)| Correspondence { first: self.points[a], second: other.points[b] }).collect();
        ransac_inliers(&matches)
    }
}
