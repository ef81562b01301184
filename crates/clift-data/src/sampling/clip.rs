//! View indices and clips; clips with half the columns and rows.

use clift_core::{Camera, ClipViews, Intrinsics};
use serde::{Deserialize, Serialize};

/// Context and target frames of a scene, as positions in the list of frames. Further fields of published evaluation indices are
/// ignored.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct ViewIndices {
    /// Frames for the encoder.
    pub context: Vec<usize>,
    /// Frames to render.
    pub target: Vec<usize>,
}

impl ViewIndices {
    /// Returns the number of targets that are also contexts. The input holds the image of such a target.
    pub fn num_context_targets(&self) -> usize {
        self.target.iter().filter(|frame| self.context.contains(frame)).count()
    }
}

/// One training or evaluation item: context and target views of one scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Clip {
    /// Key of the scene.
    pub key: String,
    /// Context views.
    pub context: ClipViews,
    /// Target views with their ground-truth images.
    pub target: ClipViews,
    /// Weights of the target pixels in loss and metrics, `[num_views, height, width]`: 255 counts, 0 is masked or
    /// transparent. `None` where every pixel counts.
    pub target_weights: Option<Vec<u8>>,
}

impl Clip {
    /// Returns the clip with half as many columns and rows: a pixel is the mean of two by two. Of an odd number of columns or
    /// rows, the last one is lost.
    #[must_use]
    pub fn at_half_resolution(&self) -> Self {
        let Self { key, context, target, target_weights } = self;
        Self {
            key: key.clone(),
            context: at_half_resolution(context),
            target: at_half_resolution(target),
            target_weights: target_weights.as_ref().map(|weights| halved_planes(weights, target)),
        }
    }
}

/// Halves images of the size of `views` with any number of channels.
fn halved_planes(pixels: &[u8], views: &ClipViews) -> Vec<u8> {
    let num_pixels = views.width * views.height * views.num_views();
    let num_channels = pixels.len() / num_pixels.max(1);
    let (width, row_bytes) = (views.width / 2, num_channels * views.width);
    let mut halved = Vec::with_capacity(pixels.len() / 4);
    for image in pixels.chunks_exact((row_bytes * views.height).max(1)) {
        for rows in image.chunks_exact(2 * row_bytes) {
            let (upper, lower) = rows.split_at(row_bytes);
            for at in (0..width).flat_map(|column| (0..num_channels).map(move |i| 2 * num_channels * column + i)) {
                let right = at + num_channels;
                let sum: u16 = [upper[at], upper[right], lower[at], lower[right]].map(u16::from).iter().sum();
                halved.push(((sum + 2) / 4) as u8);
            }
        }
    }
    halved
}

pub(crate) fn at_half_resolution(views: &ClipViews) -> ClipViews {
    let (width, height) = (views.width / 2, views.height / 2);
    let images = halved_planes(&views.images, views);
    let halved = |camera: &Camera| Camera {
        intrinsics: Intrinsics::from(camera.intrinsics.to_array().map(|pixels| pixels / 2.0)),
        ..*camera
    };
    let cameras = views.cameras.iter().map(halved).collect();
    ClipViews { width, height, images, cameras, frame_index: views.frame_index.clone() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clift_core::Pose;

    #[test]
    fn a_pixel_is_the_mean_of_two_by_two() {
        // Two views of 5 x 3 pixels: the last column and row are lost.
        let value = |index: usize| {
            let (view, row, column, channel) = (index / 45, index / 15 % 3, index / 3 % 5, index % 3);
            (100 * view + 20 * row + 4 * column + channel) as u8
        };
        let intrinsics = Intrinsics { fx: 5.0, fy: 6.0, cx: 2.5, cy: 1.0 };
        let views = ClipViews {
            width: 5,
            height: 3,
            images: (0..90).map(value).collect(),
            cameras: vec![Camera { c2w: Pose::IDENTITY, intrinsics }; 2],
            frame_index: vec![4, 2],
        };
        let weights = Some([[255; 15], [0; 15]].concat());
        let clip = Clip { key: "room".into(), context: views.clone(), target: views, target_weights: weights };
        let Clip { key, context, target, target_weights } = clip.at_half_resolution();
        assert_eq!(
            (key.as_str(), context.width, context.height, &context.frame_index[..]),
            ("room", 2, 1, &[4, 2][..])
        );
        // The mean of 0, 4, 20 and 24 is 12.
        assert_eq!(context.images, [12, 13, 14, 20, 21, 22, 112, 113, 114, 120, 121, 122]);
        let intrinsics = Intrinsics { fx: 2.5, fy: 3.0, cx: 1.25, cy: 0.5 };
        assert_eq!(context.cameras, [Camera { c2w: Pose::IDENTITY, intrinsics }; 2]);
        assert_eq!((target, target_weights), (context, Some(vec![255, 255, 0, 0])));
    }
}
