//! PSNR, SSIM and sharpness of one image, in f64.
//!
//! Images are row-major `[height, width, 3]` slices with values in [0, 1].

use crate::error::ModelError;

/// Smallest height and width that hold one SSIM window.
pub const SSIM_MIN_SIZE_PX: usize = 2 * SSIM_RADIUS + 1;

const SSIM_RADIUS: usize = 5;
const SSIM_SIGMA_PX: f64 = 1.5;
const SSIM_C1: f64 = 0.01 * 0.01;
const SSIM_C2: f64 = 0.03 * 0.03;
/// Luminance of RGB, that of scikit-image's `rgb2gray`.
const LUMINANCE: [f64; 3] = [0.2125, 0.7154, 0.0721];
/// Mean gradient of a target below which its sharpness means nothing: a quarter of an 8-bit level per pixel.
const MIN_GRADIENT: f64 = 1e-3;
/// scikit-image's `use_sample_covariance`: n / (n - 1) with n = 11 x 11.
const SAMPLE_COVARIANCE: f64 = 121.0 / 120.0;

/// Measures the peak signal-to-noise ratio in dB, after clamping both images to [0, 1].
///
/// The mean squared error is over all values. Identical images give `+inf`, which counts as 100 dB in means.
pub fn psnr(pred: &[f32], target: &[f32]) -> Result<f64, ModelError> {
    check_images(pred, target, target.len())?;
    let squared_error: f64 = pred
        .iter()
        .zip(target)
        .map(|(p, t)| (f64::from(p.clamp(0.0, 1.0)) - f64::from(t.clamp(0.0, 1.0))).powi(2))
        .sum();
    Ok(psnr_of_mse(squared_error / target.len() as f64))
}

/// Returns the PSNR in dB of a mean squared error of values in `[0, 1]`.
pub fn psnr_of_mse(mse: f64) -> f64 {
    0.0 - 10.0 * mse.log10() // 0, not -0, of a mean squared error of 1
}

/// Measures the structural similarity of two `[height, width, 3]` images; 1 for identical images.
///
/// Equals scikit-image's `structural_similarity(win_size=11, gaussian_weights=True, data_range=1)`: Gaussian window of
/// sigma 1.5 and 11 taps, sample covariance, only windows inside the image, mean over positions and then channels. The
/// images are not clamped.
pub fn ssim(pred: &[f32], target: &[f32], height: usize, width: usize) -> Result<f64, ModelError> {
    check_images(pred, target, height * width * 3)?;
    check_size("SSIM", SSIM_MIN_SIZE_PX, height, width)?;
    // Single-threaded (13 ms for 256 x 256): callers have many images to distribute over cores.
    let per_channel = [0, 1, 2].map(|channel| {
        let plane = |image: &[f32]| image.iter().skip(channel).step_by(3).map(|&v| f64::from(v)).collect();
        ssim_of_planes(plane(pred), plane(target), width)
    });
    Ok(per_channel.iter().sum::<f64>() / 3.0)
}

fn ssim_of_planes(pred: Vec<f64>, target: Vec<f64>, width: usize) -> f64 {
    let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).collect::<Vec<_>>();
    let taps = gaussian_taps();
    let squared_pred = blur(&product(&pred, &pred), width, &taps);
    let squared_target = blur(&product(&target, &target), width, &taps);
    let cross = blur(&product(&pred, &target), width, &taps);
    let (mean_pred, mean_target) = (blur(&pred, width, &taps), blur(&target, width, &taps));
    let mut sum = 0.0;
    for (i, (&p, &t)) in mean_pred.iter().zip(&mean_target).enumerate() {
        let variance_pred = SAMPLE_COVARIANCE * (squared_pred[i] - p * p);
        let variance_target = SAMPLE_COVARIANCE * (squared_target[i] - t * t);
        let covariance = SAMPLE_COVARIANCE * (cross[i] - p * t);
        let luminance = (2.0 * p * t + SSIM_C1) / (p * p + t * t + SSIM_C1);
        sum += luminance * (2.0 * covariance + SSIM_C2) / (variance_pred + variance_target + SSIM_C2);
    }
    sum / mean_pred.len() as f64
}

fn gaussian_taps() -> [f64; SSIM_MIN_SIZE_PX] {
    let taps: [f64; SSIM_MIN_SIZE_PX] = std::array::from_fn(|i| {
        let distance_px = i as f64 - SSIM_RADIUS as f64;
        (-0.5 * (distance_px / SSIM_SIGMA_PX).powi(2)).exp()
    });
    let sum: f64 = taps.iter().sum();
    taps.map(|tap| tap / sum)
}

/// Filters with `taps` along both axes, at the positions whose window lies inside the plane.
fn blur(plane: &[f64], width: usize, taps: &[f64; SSIM_MIN_SIZE_PX]) -> Vec<f64> {
    let height = plane.len() / width;
    let mut blurred = Vec::with_capacity(plane.len());
    let mut row = vec![0.0; width];
    for y in 0..=height - taps.len() {
        row.fill(0.0);
        for (tap, above) in taps.iter().zip(plane[y * width..].chunks_exact(width)) {
            for (sum, value) in row.iter_mut().zip(above) {
                *sum += tap * value;
            }
        }
        blurred.extend(row.windows(taps.len()).map(|w| w.iter().zip(taps).map(|(v, tap)| v * tap).sum::<f64>()));
    }
    blurred
}

/// Measures the sharpness of a `[height, width, 3]` image: its mean gradient magnitude over that of the target. Below 1 it
/// is blurred, 1 for identical images; noise is sharp too. `None` for a target without contrast, of a mean below 1e-3.
///
/// The gradient is that of the luminance (0.2125 R + 0.7154 G + 0.0721 B) after clamping to [0, 1], by forward differences to
/// the right and downward. The mean leaves out the last row and column, and is weighted by `weights`, one per pixel.
pub fn sharpness(
    pred: &[f32],
    target: &[f32],
    [height, width]: [usize; 2],
    weights: Option<&[u8]>,
) -> Result<Option<f64>, ModelError> {
    check_images(pred, target, height * width * 3)?;
    if height.min(width) < 2 {
        return Ok(None);
    }
    let of_target = mean_gradient(target, width, weights);
    Ok((of_target >= MIN_GRADIENT).then(|| mean_gradient(pred, width, weights) / of_target))
}

/// Returns the weighted mean; NaN where every weight is 0.
fn mean_gradient(image: &[f32], width: usize, weights: Option<&[u8]>) -> f64 {
    let luminance = |pixel: &[f32]| {
        pixel.iter().zip(LUMINANCE).map(|(&value, weight)| weight * f64::from(value.clamp(0.0, 1.0))).sum::<f64>()
    };
    let plane: Vec<f64> = image.chunks_exact(3).map(luminance).collect();
    let (mut sum, mut sum_weights) = (0.0, 0.0);
    for pixel in (0..plane.len() - width).filter(|pixel| (pixel + 1) % width > 0) {
        let weight = weights.map_or(1.0, |weights| f64::from(weights[pixel]));
        sum += weight * (plane[pixel + 1] - plane[pixel]).hypot(plane[pixel + width] - plane[pixel]);
        sum_weights += weight;
    }
    sum / sum_weights
}

/// Refuses images of another size than `expected` values, NaN and infinity.
pub fn check_images(pred: &[f32], target: &[f32], expected: usize) -> Result<(), ModelError> {
    for (image, name) in [(target, "target"), (pred, "prediction")] {
        if image.len() != expected || image.is_empty() {
            let reason = format!("image sizes differ: expected {expected} values, got {}", image.len());
            return Err(ModelError::BadImage { reason });
        }
        if let Some(index) = image.iter().position(|value| !value.is_finite()) {
            let reason = format!("the {name} is not finite: value {} at index {index}", image[index]);
            return Err(ModelError::BadImage { reason });
        }
    }
    Ok(())
}

pub fn check_size(metric: &str, min: usize, height: usize, width: usize) -> Result<(), ModelError> {
    if height.min(width) >= min {
        return Ok(());
    }
    let reason = format!("{metric} needs at least {min} x {min} pixels, got {width} x {height}");
    Err(ModelError::BadImage { reason })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Fixture;

    #[test]
    fn metrics_equal_torch_and_scikit_image() {
        let fixture = Fixture::open("metrics");
        let [count, height, width, 3] = fixture.shape("input.prediction")[..] else { panic!() };
        let [pred, target] = ["input.prediction", "input.target"].map(|name| fixture.f32s(name));
        let [expected_psnr, expected_ssim, expected_sharpness] =
            ["output.psnr", "output.ssim", "output.sharpness"].map(|name| fixture.f64s(name));
        let size = height * width * 3;
        for i in 0..count {
            let (pred, target) = (&pred[i * size..][..size], &target[i * size..][..size]);
            let (psnr, ssim) = (psnr(pred, target).unwrap(), ssim(pred, target, height, width).unwrap());
            // Both sides clamp and sum in f64, in different orders: an error of 1e-13.
            assert!(psnr == expected_psnr[i] || (psnr - expected_psnr[i]).abs() < 1e-9, "pair {i}: {psnr} dB");
            // The variances are differences of numbers near 1, divided by at least C2 = 9e-4: 1e-16 / 9e-4 = 1e-13 per
            // pixel. 1e-10 has room and still detects f32 filters (1e-6).
            assert!((ssim - expected_ssim[i]).abs() < 1e-10, "pair {i}: {ssim} is not {}", expected_ssim[i]);
            // NaN: the target has no contrast.
            let (sharpness, expected) =
                (sharpness(pred, target, [height, width], None).unwrap(), expected_sharpness[i]);
            assert_eq!(sharpness.is_none(), expected.is_nan(), "pair {i}");
            assert!(sharpness.is_none_or(|value| (value - expected).abs() < 1e-10), "pair {i}: {sharpness:?}");
        }
    }

    #[test]
    fn sharpness_counts_pixels_by_weight() {
        // Stripes of 12 x 2 pixels, of which a rendering keeps the left half and halves the contrast of the right.
        let stripes = |contrast: [f32; 2]| -> Vec<f32> {
            (0..24).flat_map(|i| [contrast[usize::from(i % 12 >= 6)] * (i % 2) as f32; 3]).collect()
        };
        let (target, pred) = (stripes([1.0, 1.0]), stripes([1.0, 0.5]));
        let right = [[0; 6], [255; 6]].concat().repeat(2);
        let sharpness = |weights| sharpness(&pred, &target, [2, 12], weights).unwrap();
        assert!((sharpness(Some(&right[..])).unwrap() - 0.5).abs() < 1e-12);
        assert!((0.5..1.0).contains(&sharpness(None).unwrap()));
        assert_eq!(sharpness(Some(&[0; 24])), None);
    }

    #[test]
    fn bad_images_are_errors() {
        let image = vec![0.5; 11 * 11 * 3];
        assert!((ssim(&image, &image, 11, 11).unwrap() - 1.0).abs() < 1e-15);
        for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let mut pred = image.clone();
            pred[7] = value;
            let sharpness = sharpness(&pred, &image, [11, 11], None).map(Option::unwrap_or_default);
            for result in [psnr(&pred, &image), ssim(&pred, &image, 11, 11), sharpness] {
                let expected = format!("the prediction is not finite: value {value} at index 7");
                assert_eq!(result.unwrap_err().to_string(), expected);
            }
        }
        let message = ssim(&image[..10 * 11 * 3], &image[..10 * 11 * 3], 10, 11).unwrap_err().to_string();
        assert_eq!(message, "SSIM needs at least 11 x 11 pixels, got 11 x 10");
        assert_eq!(
            psnr(&[0.5; 9], &[0.5; 12]).unwrap_err().to_string(),
            "image sizes differ: expected 12 values, got 9"
        );
        assert!(psnr(&[], &[]).is_err() && ssim(&image[..12], &image[..12], 11, 11).is_err());
    }
}
