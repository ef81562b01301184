//! Images and intrinsics rescaled and cropped to the model's size.

use clift_core::{Intrinsics, IntrinsicsNorm, RgbImage};
use serde::{Deserialize, Serialize};

use crate::error::DataError;
use crate::image::lanczos::{Window, resize_lanczos_window};

/// Position of the principal point in a cropped image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Crop {
    /// Keeps the offset from the image centre, as in published results: half a pixel off if the margin is odd.
    #[default]
    Protocol,
    /// Moves with the cropped pixels.
    Exact,
}

/// Rescales an image to the smallest size that covers `width` by `height` pixels, crops the centre, and adapts the
/// intrinsics, as pixelSplat's `rescale_and_crop`.
///
/// Focal lengths, in pixels, are `fx_norm * scaled_width` and `fy_norm * scaled_height`. The principal point is
/// `cx = width / 2 + (cx_norm - 0.5) * scaled_width`, and `cy` likewise: half a pixel off if the margin
/// `scaled_width - width` is odd, as in published results. With `exact_principal_point`,
/// `cx = cx_norm * scaled_width - floor(margin / 2)`.
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
    exact_principal_point: bool,
) -> Result<(RgbImage, Intrinsics), DataError> {
    if width > image.width || height > image.height {
        return Err(DataError::Upscale { width, height, from_width: image.width, from_height: image.height });
    }
    let (scaled_width, scaled_height) = covering_size((image.width, image.height), (width, height));
    let (column, row) = ((scaled_width - width) / 2, (scaled_height - height) / 2);
    let cropped = resize_lanczos_window(image, scaled_width, scaled_height, Window { column, row, width, height });
    let in_scaled = intrinsics_norm.to_pixels(scaled_width, scaled_height);
    let (cx, cy) = if exact_principal_point {
        (in_scaled.cx - column as f64, in_scaled.cy - row as f64)
    } else {
        let from_centre = |at: f64, scaled: usize| (at - 0.5) * scaled as f64;
        let x = width as f64 / 2.0 + from_centre(intrinsics_norm.cx, scaled_width);
        (x, height as f64 / 2.0 + from_centre(intrinsics_norm.cy, scaled_height))
    };
    Ok((cropped, Intrinsics { fx: in_scaled.fx, fy: in_scaled.fy, cx, cy }))
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
    use crate::testing::ramp;

    #[test]
    fn sizes_crops_and_focal_lengths_equal_the_protocol() {
        // (source) -> (target): rescaled size, crop offset, factor of fx, exact principal point, all as width first.
        let table = [
            ((640, 360), (256, 256), (455, 256), (99, 0), 1.777_34, 128.5),
            ((480, 270), (448, 256), (455, 256), (3, 0), 1.015_625, 224.5),
            ((960, 540), (448, 256), (455, 256), (3, 0), 1.015_625, 224.5),
            ((640, 360), (448, 256), (455, 256), (3, 0), 1.015_625, 224.5),
        ];
        for (from, to, scaled, offset, factor, exact) in table {
            assert_eq!(covering_size(from, to), scaled);
            assert_eq!(((scaled.0 - to.0) / 2, (scaled.1 - to.1) / 2), offset);
            let norm = IntrinsicsNorm { fx: 0.9, fy: 1.6, cx: 0.5, cy: 0.5 };
            let image = RgbImage { width: from.0, height: from.1, rgb: vec![9; from.0 * from.1 * 3] };
            let (fitted, protocol) = fit_image(&image, norm, to.0, to.1, false).unwrap();
            assert_eq!((fitted.width, fitted.height, fitted.rgb.len()), (to.0, to.1, to.0 * to.1 * 3));
            assert!((protocol.fx / to.0 as f64 / norm.fx - factor).abs() < 1e-5, "{protocol:?}"); // printed to 5 digits
            assert_eq!((protocol.fy, protocol.cx, protocol.cy), (1.6 * 256.0, to.0 as f64 / 2.0, 128.0));
            let (_, moved) = fit_image(&image, norm, to.0, to.1, true).unwrap();
            assert_eq!((moved.fx, moved.cx, moved.cy), (protocol.fx, exact, 128.0));
        }
    }

    #[test]
    fn protocol_and_exact_principal_points_differ_by_half_a_pixel() {
        let image = ramp(108, 192);
        let norm = IntrinsicsNorm { fx: 1.27, fy: 0.72, cx: 0.6, cy: 0.55 };
        let [protocol, exact] = [false, true].map(|exact| fit_image(&image, norm, 64, 64, exact).unwrap().1);
        // 64 x 114, 25 rows cut off above and below: 0.55 * 114 - 25 = 37.7.
        assert!((exact.cx - 38.4).abs() < 1e-12 && (exact.cy - 37.7).abs() < 1e-12, "{exact:?}");
        assert!((protocol.cx - exact.cx).abs() < 1e-12 && (protocol.cy - exact.cy).abs() < 1e-12, "{protocol:?}");
        let odd = fit_image(&ramp(108, 193), norm, 64, 63, false).unwrap().1;
        let exact = fit_image(&ramp(108, 193), norm, 64, 63, true).unwrap().1;
        assert!((odd.cy - exact.cy).abs() <= 0.5 + 1e-12, "{odd:?} {exact:?}");
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
            let (fitted, _) = fit_image(&image, norm, width, height, false).unwrap();
            let differences = fitted.rgb.iter().zip(expected.data()).map(|(a, b)| a.abs_diff(*b));
            let mean = differences.clone().map(f64::from).sum::<f64>() / fitted.rgb.len() as f64;
            // Decoders enlarge the chroma differently; the mean is 0.07 to 0.28 for real photos (docs/contributing.md).
            assert!(mean < 0.5 && differences.max() <= Some(8), "{number}: {mean}");
        }
    }
}
