//! Pillow's 8-bit LANCZOS resize, bit for bit.
//!
//! Two passes, columns then rows, with weights in 22-bit fixed point and results rounded to 8 bits: the resize behind
//! published results. `fast_image_resize` 6.1 has 16-bit weights and is faster (0.5 against 2.2 ms per photo), but
//! changes 8 % of the values of a real photo, by up to 35 levels at hard edges.

use std::f64::consts::PI;
use std::ops::Range;

use clift_core::RgbImage;
use multiversion::multiversion;

/// Fraction bits of a weight: 32 minus 8 for the pixel and 2 for the overshoot of a sum.
const PRECISION_BITS: u32 = 32 - 8 - 2;
/// Radius of the filter in pixels of the smaller image.
const SUPPORT: f64 = 3.0;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Window {
    pub column: usize,
    pub row: usize,
    pub width: usize,
    pub height: usize,
}

/// Resizes to `width` by `height` pixels, with antialiasing where the image is reduced.
///
/// # Panics
/// Panics if a size is zero or `image.rgb` does not have `height * width * 3` values.
pub fn resize_lanczos(image: &RgbImage, width: usize, height: usize) -> RgbImage {
    resize_lanczos_window(image, width, height, Window { column: 0, row: 0, width, height })
}

/// Returns the part `window` of the result of [`resize_lanczos`], without computing the other pixels: nearly half of
/// them for a 256 x 256 crop of a 640 x 360 photo.
///
/// # Panics
/// Panics like [`resize_lanczos`], and if the window is not inside `width` by `height`.
pub fn resize_lanczos_window(image: &RgbImage, width: usize, height: usize, window: Window) -> RgbImage {
    assert_eq!(image.rgb.len(), image.height * image.width * 3, "an image of {}x{}", image.width, image.height);
    assert!(image.width * image.height * window.width * window.height > 0, "an image without pixels");
    let [column_end, row_end] = [window.column + window.width, window.row + window.height];
    assert!(column_end <= width && row_end <= height, "{window:?} of {width}x{height}");
    let column_taps = (width != image.width).then(|| weights(image.width, width, window.column..column_end));
    let row_taps = (height != image.height).then(|| weights(image.height, height, window.row..row_end));
    // Input rows that the rows of the window depend on.
    let [top, bottom] = match row_taps.as_deref() {
        Some([first, .., last]) => [first.first, last.first + last.weights.len()],
        Some([only]) => [only.first, only.first + only.weights.len()],
        _ => [window.row, row_end],
    };
    let input = &image.rgb[top * image.width * 3..bottom * image.width * 3];
    let narrowed = if let Some(taps) = &column_taps {
        resize_columns(input, image.width, taps)
    } else {
        let rows = input.chunks_exact(image.width * 3);
        rows.flat_map(|row| &row[window.column * 3..column_end * 3]).copied().collect()
    };
    let rgb = match &row_taps {
        Some(taps) => resize_rows(&narrowed, window.width * 3, top, taps),
        None => narrowed,
    };
    RgbImage { width: window.width, height: window.height, rgb }
}

/// Weights of one output pixel, and the input pixel of the first weight.
struct Taps {
    first: usize,
    weights: Vec<i32>,
}

/// Returns the taps of the output pixels `pixels` along one axis that is resized from `from` to `to` pixels.
fn weights(from: usize, to: usize, pixels: Range<usize>) -> Vec<Taps> {
    let scale = from as f64 / to as f64;
    let stretch = scale.max(1.0);
    let support = SUPPORT * stretch;
    let taps = |pixel: usize| {
        let centre = (pixel as f64 + 0.5) * scale;
        // Truncated like Pillow's C cast; negative values are clamped.
        let first = (centre - support + 0.5).max(0.0) as usize;
        let end = ((centre + support + 0.5) as usize).min(from);
        let values: Vec<f64> =
            (first..end).map(|index| lanczos((index as f64 - centre + 0.5) * (1.0 / stretch))).collect();
        let sum: f64 = values.iter().sum();
        let fixed = |value: &f64| {
            let scaled = value / sum * f64::from(1 << PRECISION_BITS);
            (scaled + 0.5_f64.copysign(scaled)) as i32
        };
        Taps { first, weights: values.iter().map(fixed).collect() }
    };
    pixels.map(taps).collect()
}

fn lanczos(x: f64) -> f64 {
    let sinc = |x: f64| if x == 0.0 { 1.0 } else { (x * PI).sin() / (x * PI) };
    if (-SUPPORT..SUPPORT).contains(&x) { sinc(x) * sinc(x / SUPPORT) } else { 0.0 }
}

/// Converts a sum of weighted pixels to 8 bits. The sum starts at one half.
fn round(sum: i32) -> u8 {
    (sum >> PRECISION_BITS).clamp(0, 255) as u8
}

/// Resizes the rows of an image along the columns. The sums are integers: equal with and without AVX2.
#[multiversion(targets("x86_64+avx2"))]
fn resize_columns(rgb: &[u8], width: usize, taps: &[Taps]) -> Vec<u8> {
    let mut resized = Vec::with_capacity(rgb.len() / width * taps.len());
    // Four channels, one of them unused, make a pixel one vector.
    let mut wide = vec![[0_i32; 4]; width];
    for row in rgb.chunks_exact(width * 3) {
        for (pixel, [r, g, b]) in wide.iter_mut().zip(row.as_chunks::<3>().0) {
            *pixel = [i32::from(*r), i32::from(*g), i32::from(*b), 0];
        }
        for Taps { first, weights } in taps {
            let mut sums = [1 << (PRECISION_BITS - 1); 4];
            for (pixel, weight) in wide[*first..].iter().zip(weights) {
                for (sum, value) in sums.iter_mut().zip(pixel) {
                    *sum += value * weight;
                }
            }
            let [r, g, b, _] = sums.map(round);
            resized.extend([r, g, b]);
        }
    }
    resized
}

/// Resizes an image along the rows. `rgb` starts with row `top` of the image whose rows the taps index.
#[multiversion(targets("x86_64+avx2"))]
fn resize_rows(rgb: &[u8], row_bytes: usize, top: usize, taps: &[Taps]) -> Vec<u8> {
    let mut resized = Vec::with_capacity(row_bytes * taps.len());
    let mut sums = vec![0; row_bytes];
    for Taps { first, weights } in taps {
        sums.fill(1 << (PRECISION_BITS - 1));
        for (row, weight) in rgb[(first - top) * row_bytes..].chunks_exact(row_bytes).zip(weights) {
            for (sum, value) in sums.iter_mut().zip(row) {
                *sum += i32::from(*value) * weight;
            }
        }
        resized.extend(sums.iter().map(|sum| round(*sum)));
    }
    resized
}

#[cfg(test)]
mod tests {
    use super::*;
    use safetensors::SafeTensors;

    #[test]
    fn resized_images_equal_pillow_bit_for_bit() {
        let bytes = include_bytes!("../../../../data-fixtures/reference/lanczos.safetensors");
        let tensors = SafeTensors::deserialize(bytes).unwrap();
        let image = |name: &str| {
            let tensor = tensors.tensor(name).unwrap();
            let &[height, width, 3] = tensor.shape() else { panic!("{name} has shape {:?}", tensor.shape()) };
            RgbImage { width, height, rgb: tensor.data().to_vec() }
        };
        let mut num_cases = 0;
        while tensors.tensor(&format!("{num_cases}.input")).is_ok() {
            let expected = image(&format!("{num_cases}.output"));
            let got = resize_lanczos(&image(&format!("{num_cases}.input")), expected.width, expected.height);
            assert!(got == expected, "case {num_cases}, {}x{}", expected.width, expected.height);
            num_cases += 1;
        }
        assert_eq!(num_cases, 10);
    }
}
