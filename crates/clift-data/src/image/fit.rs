//! Images and intrinsics rescaled and cropped to the model's size.

use clift_core::{Intrinsics, IntrinsicsNorm, RgbImage};

use crate::error::DataError;
use crate::image::lanczos::{Window, resize_lanczos_window};

/// Rescales an image to the smallest size that covers `width` by `height` pixels, crops the centre, and adapts the
/// intrinsics, as pixelSplat's `rescale_and_crop`.
///
/// Focal lengths, in pixels, are `fx_norm * scaled_width` and `fy_norm * scaled_height`. The principal point is
/// `cx = width / 2 + (cx_norm - 0.5) * scaled_width`, and `cy` likewise: half a pixel off if the margin
/// `scaled_width - width` is odd, as in published results.
///
// Departs from pixelSplat, which keeps cx_norm: correct for a principal point at the centre, as in RealEstate10K, and
// wrong by (cx_norm - 0.5) * margin elsewhere, as in phone photos.
///
/// # Errors
/// [`DataError::Upscale`] if `width` or `height` exceeds that of the image.
pub fn fit_image(
    image: &RgbImage,
    intrinsics_norm: IntrinsicsNorm,
    width: usize,
    height: usize,
) -> Result<(RgbImage, Intrinsics), DataError> {
    if width > image.width || height > image.height {
        return Err(DataError::Upscale { width, height, from_width: image.width, from_height: image.height });
    }
    let (scaled_width, scaled_height) = covering_size((image.width, image.height), (width, height));
    let (column, row) = ((scaled_width - width) / 2, (scaled_height - height) / 2);
    let cropped = resize_lanczos_window(image, scaled_width, scaled_height, Window { column, row, width, height });
    let Intrinsics { fx, fy, .. } = intrinsics_norm.to_pixels(scaled_width, scaled_height);
    let centre = |at: f64, scaled: usize, side: usize| side as f64 / 2.0 + (at - 0.5) * scaled as f64;
    let cx = centre(intrinsics_norm.cx, scaled_width, width);
    let cy = centre(intrinsics_norm.cy, scaled_height, height);
    Ok((cropped, Intrinsics { fx, fy, cx, cy }))
}

/// Returns the smallest size with the aspect ratio of `from` that covers `to`, all as (width, height).
pub(crate) fn covering_size(from: (usize, usize), to: (usize, usize)) -> (usize, usize) {
    let scale = (to.1 as f64 / from.1 as f64).max(to.0 as f64 / from.0 as f64);
    let side = |from: usize| (from as f64 * scale).round_ties_even() as usize;
    (side(from.0), side(from.1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::codec::decode_image;

    #[test]
    fn sizes_crops_and_focal_lengths_equal_the_protocol() {
        // (source) -> (target): rescaled size and factor of fx, all as width first.
        let table = [
            ((640, 360), (256, 256), (455, 256), 1.777_34),
            ((480, 270), (448, 256), (455, 256), 1.015_625),
            ((108, 192), (64, 64), (64, 114), 1.0),
        ];
        for (from, to, scaled, factor) in table {
            assert_eq!(covering_size(from, to), scaled);
            let norm = IntrinsicsNorm { fx: 0.9, fy: 1.6, cx: 0.5, cy: 0.55 };
            let image = RgbImage { width: from.0, height: from.1, rgb: vec![9; from.0 * from.1 * 3] };
            let (fitted, protocol) = fit_image(&image, norm, to.0, to.1).unwrap();
            assert_eq!((fitted.width, fitted.height, fitted.rgb.len()), (to.0, to.1, to.0 * to.1 * 3));
            assert!((protocol.fx / to.0 as f64 / norm.fx - factor).abs() < 1e-5, "{protocol:?}"); // printed to 5 digits
            assert_eq!((protocol.fy, protocol.cx), (1.6 * scaled.1 as f64, to.0 as f64 / 2.0));
            // Of 114 rows, 25 are cut off above and below: 0.55 * 114 - 25 = 37.7.
            let cy = 0.55 * scaled.1 as f64 - (scaled.1 - to.1) as f64 / 2.0;
            assert!((protocol.cy - cy).abs() < 1e-9, "{protocol:?}");
        }
    }

    #[test]
    fn fitted_jpegs_equal_pillow_within_one_level() {
        let bytes = include_bytes!("../../../../data-fixtures/reference/fitted.safetensors");
        let tensors = safetensors::SafeTensors::deserialize(bytes).unwrap();
        let norm = IntrinsicsNorm { fx: 1.0, fy: 1.0, cx: 0.5, cy: 0.5 };
        for number in 0..3 {
            let expected = tensors.tensor(&format!("{number}.output")).unwrap();
            let &[height, width, 3] = expected.shape() else { panic!("{:?}", expected.shape()) };
            let file = tensors.tensor(&format!("{number}.jpeg")).unwrap().data();
            // The luma sampling of the frame header is 2 x 2: decoders must enlarge the chroma (4:2:0).
            let header = file.windows(2).position(|marker| marker == [0xff, 0xc0]).unwrap();
            assert_eq!(file[header + 11], 0x22);
            let image = decode_image(file, "k", 0).unwrap();
            let (fitted, _) = fit_image(&image, norm, width, height).unwrap();
            let differences = fitted.rgb.iter().zip(expected.data()).map(|(a, b)| a.abs_diff(*b));
            let mean = differences.clone().map(f64::from).sum::<f64>() / fitted.rgb.len() as f64;
            // Decoders enlarge the chroma differently; the mean is 0.07 to 0.28 for real photos (docs/contributing.md).
            assert!(mean < 0.5 && differences.max() <= Some(8), "{number}: {mean}");
        }
    }
}
