//! The training loss (paper section 3.3). The perceptual term will stand here beside the squared error.

use burn::tensor::Tensor;

/// Mean squared error over all values of all pictures.
///
/// # Shapes
/// - `rendering`, `target`: `[batch, views, height, width, 3]` in `[0, 1]`
/// - returns a scalar, `[1]`
pub fn mse(rendering: Tensor<5>, target: Tensor<5>) -> Tensor<1> {
    (rendering - target).square().mean()
}

/// PSNR in dB of a mean squared error of values in `[0, 1]`.
pub fn psnr_of(mse: f64) -> f64 {
    -10.0 * mse.log10()
}
