//! Images to patch vectors and back. Token `v * (h * w) + y * w + x` is patch `(y, x)` of view `v`; value
//! `(p1 * patch + p2) * channels + c` of a patch is channel `c` of row `p1`, column `p2`.
// B scenes, V views, H rows, W columns, C channels, p patch side, h = H/p, w = W/p

use burn::tensor::Tensor;

/// Divides every view into patches, one vector per patch.
///
/// # Shapes
/// - `pixels`: `[batch, views, height, width, channels]`, sides multiples of `patch_size`
/// - returns `[batch, views * (height / patch_size) * (width / patch_size), patch_size^2 * channels]`
pub fn patchify(pixels: Tensor<5>, patch_size: usize) -> Tensor<3> {
    let [batch, views, height, width, channels] = pixels.dims();
    let (rows, columns) = (height / patch_size, width / patch_size);
    assert!(
        rows * patch_size == height && columns * patch_size == width,
        "{height} x {width} does not divide into patches of {patch_size}"
    );
    pixels
        .reshape([batch * views, rows, patch_size, columns, patch_size, channels])
        .permute([0, 1, 3, 2, 4, 5]) // [BV, h, w, p, p, C]
        .reshape([batch, views * rows * columns, patch_size * patch_size * channels])
}

/// Assembles images from patch vectors: the inverse of `patchify`.
///
/// # Shapes
/// - `patches`: `[batch, views * (height / patch_size) * (width / patch_size), patch_size^2 * channels]`
/// - `shape`: `[views, height, width]`
/// - returns `[batch, views, height, width, channels]`
pub fn unpatchify(patches: Tensor<3>, shape: [usize; 3], patch_size: usize) -> Tensor<5> {
    let [batch, num_patches, values] = patches.dims();
    let [views, height, width] = shape;
    let (rows, columns) = (height / patch_size, width / patch_size);
    assert_eq!(num_patches, views * rows * columns, "patches of {views} views of {height} x {width}");
    let channels = values / (patch_size * patch_size);
    patches
        .reshape([batch * views, rows, columns, patch_size, patch_size, channels])
        .permute([0, 1, 3, 2, 4, 5]) // [BV, h, p, w, p, C]
        .reshape([batch, views, height, width, channels])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{Fixture, assert_close, devices};

    #[test]
    fn patches_and_images_equal_pytorch() {
        let fixture = Fixture::open("patches");
        for device in devices() {
            let images = fixture.tensor::<5>("input.images", &device);
            let rays = fixture.tensor::<5>("input.plucker", &device);
            let context = patchify(Tensor::cat(vec![images, rays.clone()], 4), 8);
            assert_close(&context, &fixture.tensor::<3>("output.context_patches", &device), 0.0);
            assert_close(&patchify(rays, 8), &fixture.tensor::<3>("output.ray_patches", &device), 0.0);
            let pixels = unpatchify(fixture.tensor("input.pixels_patches", &device), [3, 16, 24], 8);
            assert_close(&pixels, &fixture.tensor::<5>("output.pixels", &device), 0.0);
        }
    }
}
