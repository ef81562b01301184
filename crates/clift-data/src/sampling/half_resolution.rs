//! Clips with half the columns and rows.

use clift_core::{Camera, ClipViews, Intrinsics};

use crate::sampling::clip::Clip;

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
        let (width, height) = (5, 3);
        let value = |view: usize, row: usize, column: usize, channel: usize| {
            (100 * view + 20 * row + 4 * column + channel) as u8
        };
        let mut images = Vec::new();
        for (view, row) in (0..2).flat_map(|view| (0..height).map(move |row| (view, row))) {
            images.extend((0..width).flat_map(|column| (0..3).map(move |channel| value(view, row, column, channel))));
        }
        let k = Intrinsics { fx: 5.0, fy: 6.0, cx: 2.5, cy: 1.0 };
        let views = ClipViews {
            width,
            height,
            images,
            cameras: vec![Camera { c2w: Pose::IDENTITY, intrinsics: k }; 2],
            frame_index: vec![4, 2],
        };
        let clip = Clip { key: "room".into(), context: views.clone(), target: views, target_weights: None };
        let Clip { key, context, target, .. } = clip.at_half_resolution();
        assert_eq!((key.as_str(), context.width, context.height), ("room", 2, 1));
        // The mean of 0, 4, 20 and 24 is 12.
        assert_eq!(context.images, [12, 13, 14, 20, 21, 22, 112, 113, 114, 120, 121, 122]);
        let intrinsics = Intrinsics { fx: 2.5, fy: 3.0, cx: 1.25, cy: 0.5 };
        assert_eq!(context.cameras, [Camera { c2w: Pose::IDENTITY, intrinsics }; 2]);
        assert_eq!(context.frame_index, [4, 2]);
        assert_eq!(target, context);
    }
}
