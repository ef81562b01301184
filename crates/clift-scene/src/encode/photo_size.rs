//! The size at which a network sees whole photos.

/// Largest ratio of the sides of an image; longer photos are cropped.
const MAX_ASPECT: f64 = 2.0;

/// Cost of the share of the trained pixels that a size lacks, relative to the difference in log aspect ratio.
const AREA_WEIGHT: f64 = 0.5;

/// Returns width and height of images that show nearly all of a photo of `photo` pixels: multiples of the patch in about the
/// proportions of the photo, with about as many pixels as the `trained` size, and no more.
pub fn photo_size(trained: [usize; 2], patch_size: usize, photo: [usize; 2]) -> [usize; 2] {
    let most = (trained[0] / patch_size * (trained[1] / patch_size)).max(1);
    let aspect = (photo[0].max(1) as f64 / photo[1].max(1) as f64).clamp(1.0 / MAX_ASPECT, MAX_ASPECT);
    let longer_by = aspect.max(aspect.recip());
    let sizes = (1..=most.isqrt()).map(|shorter| {
        let longer = ((shorter as f64 * longer_by).round() as usize).clamp(shorter, most / shorter);
        let difference = (longer as f64 / shorter as f64 / longer_by).ln().abs();
        let cost = difference + AREA_WEIGHT * (1.0 - (longer * shorter) as f64 / most as f64);
        (cost, [longer, shorter].map(|count| count * patch_size))
    });
    let (_, [longer, shorter]) = sizes.min_by(|a, b| a.0.total_cmp(&b.0)).expect("at least one size");
    if aspect >= 1.0 { [longer, shorter] } else { [shorter, longer] }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_have_the_proportions_of_the_photo_and_no_more_pixels_than_in_training() {
        let size = |photo| photo_size([128, 128], 8, photo);
        assert_eq!(size([500, 500]), [128, 128]);
        assert_eq!([size([640, 480]), size([480, 640])], [[144, 112], [112, 144]]);
        assert_eq!(size([1920, 1080]), [168, 96]);
        assert_eq!(size([8000, 1000]), [176, 88], "a panorama is cropped");
        for (width, height) in (1..40).flat_map(|width| (1..40).map(move |height| (width * 31, height * 17))) {
            let [w, h] = size([width, height]);
            assert!(w * h <= 128 * 128 && w.is_multiple_of(8) && h.is_multiple_of(8), "{width} x {height}: {w} x {h}");
            let aspect = (width as f64 / height as f64).clamp(0.5, 2.0);
            assert!((w as f64 / h as f64 / aspect).ln().abs() < 0.1, "{width} x {height}: {w} x {h}");
        }
        assert_eq!(photo_size([16, 16], 16, [300, 100]), [16, 16], "a single patch");
    }
}
