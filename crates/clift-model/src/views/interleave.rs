//! Images larger than the training size, interleaved from several images of about the training size.
//!
//! A network draws well at the size it was trained on: at twice that size its patches cover half the angle. Every k-th pixel
//! of every k-th row is an image of the trained size. k x k such images, each with the rays of its pixels, make the large one.
// B scenes, V views, k images along either axis, H rows, W columns

use burn::tensor::{Tensor, TensorData};

use crate::views::upload::Cameras;

/// Returns the number of images along either axis that an image of `size` is interleaved from, and their size; sizes are
/// `[height, width]`.
pub fn phases(trained_height: usize, patch_size: usize, size: [usize; 2]) -> (usize, [usize; 2]) {
    let k = ((size[0] as f64 / trained_height as f64).round() as usize).max(1);
    if k == 1 { (k, size) } else { (k, size.map(|side| side.div_ceil(k).next_multiple_of(patch_size))) }
}

/// Draws views of any size as interleaved images of about the rows of `trained_height`, sides rounded up to whole patches.
///
/// # Shapes
/// - `draw`: of cameras of any size, `[batch, views, height, width, 3]`
/// - returns `[batch, views, height, width, 3]` of the size of `targets`
pub fn interleaved(
    trained_height: usize,
    patch_size: usize,
    targets: &Cameras,
    draw: impl Fn(&Cameras) -> Tensor<5>,
) -> Tensor<5> {
    let (k, [height, width]) = phases(trained_height, patch_size, [targets.height, targets.width]);
    if k == 1 {
        return draw(targets);
    }
    let [batch, views] = targets.dims();
    // Pixel u of the image at phase j is pixel k u + j of the whole: x = (k u + j + 0.5 - cx) / fx.
    let options = (&targets.intrinsics.device(), targets.intrinsics.dtype());
    let scale = 1.0 / k as f64;
    let shift = |phase: usize| 0.5 - (phase as f64 + 0.5) * scale;
    let shifts: Vec<f64> =
        (0..k).flat_map(|row| (0..k).flat_map(move |column| [0.0, 0.0, shift(column), shift(row)])).collect();
    let shifts = Tensor::<4>::from_data(TensorData::new(shifts, [1, 1, k * k, 4]), options);
    let intrinsics = targets.intrinsics.clone().mul_scalar(scale).unsqueeze_dim::<4>(2) + shifts; // [B, V, kk, 4]
    let c2w = targets.c2w.clone().unsqueeze_dim::<5>(2).expand([batch, views, k * k, 4, 4]);
    let images = draw(&Cameras {
        height,
        width,
        c2w: c2w.reshape([batch, views * k * k, 4, 4]),
        intrinsics: intrinsics.reshape([batch, views * k * k, 4]),
    });
    images
        .reshape([batch * views, k, k, height, width, 3])
        .permute([0, 3, 1, 4, 2, 5]) // [BV, H, k, W, k, 3]
        .reshape([batch, views, height * k, width * k, 3])
        .narrow(2, 0, targets.height)
        .narrow(3, 0, targets.width)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{assert_close, devices, random};
    use crate::views::rays::plucker;

    #[test]
    fn every_pixel_is_drawn_with_its_own_ray() {
        for device in devices() {
            let c2w = Tensor::<2>::eye(4, &device).reshape([1, 1, 4, 4]).expand([2, 3, 4, 4]);
            let intrinsics = random([2, 3, 4], 1, &device).cast(c2w.dtype()).mul_scalar(0.3).add_scalar(9.0);
            // Twice and three times the trained height of 8 pixels, with a rest; and about the trained size.
            for (height, width, k) in [(16, 24, 2), (20, 36, 3), (8, 12, 1), (4, 8, 1)] {
                let targets = Cameras { height, width, c2w: c2w.clone(), intrinsics: intrinsics.clone() };
                // Directions stand for colours.
                let draw = |cameras: &Cameras| {
                    assert_eq!(cameras.dims(), [2, 3 * k * k]);
                    assert!(cameras.height <= 12 && cameras.height.is_multiple_of(4), "{}", cameras.height);
                    plucker(cameras).narrow(4, 3, 3)
                };
                let expected = plucker(&targets).narrow(4, 3, 3);
                assert_close(&interleaved(8, 4, &targets, draw), &expected, 2e-6);
            }
        }
    }
}
