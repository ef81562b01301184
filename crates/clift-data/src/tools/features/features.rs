//! Corners of images, matched between images without their cameras: the reference for checking poses.
//!
//! Corners are found in two sizes of an image, described by the gradients around them, matched both ways, and kept if
//! they agree with one fundamental matrix.

use crate::image::lanczos::resize_lanczos;
use crate::image::rgb_image::RgbImage;
use crate::tools::features::correspondence::{Correspondence, WIDTH};
use crate::tools::features::descriptor::Descriptor;
use crate::tools::features::epipolar::{self};
use crate::tools::features::gray_image::GrayImage;
use crate::tools::features::{corners, matching};

/// Most corners of the two sizes of an image.
const MAX_CORNERS: [usize; 2] = [900, 500];
/// Size of the smaller image over the larger: its corners match those of a surface that the other image shows from
/// farther away.
const SMALLER: f64 = 0.6;

/// Corners of an image, in pixels of the image [`WIDTH`] columns wide, and their descriptors.
#[derive(Clone, Debug, Default)]
pub struct Features {
    points: Vec<[f64; 2]>,
    descriptors: Vec<Descriptor>,
}

impl Features {
    /// Finds the corners of an image.
    pub fn find(frame: &RgbImage) -> Self {
        let shown = reduced(frame);
        let unit = WIDTH as f64 / shown.width as f64;
        let smaller = |side: usize| ((side as f64 * SMALLER).round() as usize).max(1);
        let second = resize_lanczos(&shown, smaller(shown.width), smaller(shown.height));
        let mut features = Self::default();
        for (image, count) in [&shown, &second].into_iter().zip(MAX_CORNERS) {
            let gray = GrayImage::new(image).blurred();
            let (scale_x, scale_y) =
                (shown.width as f64 / image.width as f64 * unit, shown.height as f64 / image.height as f64 * unit);
            for [x, y] in corners::find(&gray, count) {
                if let Some(descriptor) = Descriptor::at(&gray, x, y) {
                    features.points.push([x * scale_x, y * scale_y]);
                    features.descriptors.push(descriptor);
                }
            }
        }
        features
    }

    /// Pairs of corners that are clearly most similar to each other and agree with one epipolar geometry.
    /// Deterministic; empty if too few agree, as for images of different places.
    pub fn matches(&self, other: &Self) -> Vec<Correspondence> {
        let pairs = matching::mutual(&self.descriptors, &other.descriptors);
        let matches: Vec<Correspondence> =
            pairs.into_iter().map(|(a, b)| Correspondence { first: self.points[a], second: other.points[b] }).collect();
        epipolar::ransac_inliers(&matches)
    }
}

/// Reduces an image to at most [`WIDTH`] columns.
pub fn reduced(frame: &RgbImage) -> RgbImage {
    if frame.width <= WIDTH {
        return frame.clone();
    }
    let height = (frame.height as f64 * WIDTH as f64 / frame.width as f64).round().max(1.0) as usize;
    resize_lanczos(frame, WIDTH, height)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_source::SceneSource;
    use crate::synthetic::config::SyntheticConfig;
    use crate::synthetic::source::SyntheticSource;
    use crate::tools::features::epipolar::{epipolar_distance, fundamental_from_cameras};

    fn room() -> SyntheticSource {
        let config = SyntheticConfig {
            num_scenes: 1,
            num_frames: 24,
            width: 320,
            height: 240,
            path_length: 1.2,
            texture_frequency: 3.0,
            specular: 0.1,
            ..Default::default()
        };
        SyntheticSource::new(config).unwrap()
    }

    #[test]
    fn a_image_matches_itself_in_place() {
        let features = Features::find(&room().frame(0, 0).unwrap());
        assert!(features.points.len() > 80, "{}", features.points.len());
        let matches = features.matches(&features);
        // A pattern that repeats has no clear match.
        assert!(matches.len() > features.points.len() / 2, "{} of {}", matches.len(), features.points.len());
        assert!(matches.iter().all(|pair| pair.first == pair.second));
    }

    #[test]
    fn matches_of_two_views_lie_on_each_others_epipolar_lines() {
        let source = room();
        let cameras = source.cameras(0).unwrap();
        let matches =
            Features::find(&source.frame(0, 4).unwrap()).matches(&Features::find(&source.frame(0, 6).unwrap()));
        let geometry = fundamental_from_cameras([&cameras[4], &cameras[6]], [[320, 240]; 2]);
        let mut distances: Vec<f64> = matches.iter().map(|pair| epipolar_distance(&geometry, pair)).collect();
        distances.sort_by(f64::total_cmp);
        assert!(matches.len() > 40, "{}", matches.len());
        assert!(distances[matches.len() / 2] < 1.0, "{distances:?}"); // half a pixel of the image, which is 320 wide
    }

    #[test]
    fn images_of_one_colour_have_no_corners() {
        let features = Features::find(&RgbImage { width: 64, height: 48, rgb: vec![90; 64 * 48 * 3] });
        assert!(features.points.is_empty() && features.matches(&features).is_empty());
        assert!(Features::find(&RgbImage { width: 3, height: 2, rgb: vec![9; 18] }).points.is_empty());
    }
}
