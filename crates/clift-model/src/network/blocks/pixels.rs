//! Between pixels and the residual stream: embedding of context and target patches, and decoding of images.
// B scenes, V context views, T target views, Q patches of a view, D width

use burn::nn::{LayerNorm, Linear};
use burn::tensor::Tensor;
use burn::tensor::activation::sigmoid;

use crate::ops::linear::{linear_in_f32, norm_linear};
use crate::views::patch::{patchify, unpatchify};
use crate::views::rays::{RayFrame, rays};
use crate::views::upload::Cameras;

/// Embeds colours and rays of context patches.
///
/// # Shapes
/// - `colors`: `[batch, views, height, width, 3]`
/// - returns `[batch, views * patches, dim]`
pub fn embed_context(
    layer: &Linear,
    colors: Tensor<5>,
    cameras: &Cameras,
    patch_size: usize,
    frame: RayFrame,
) -> Tensor<3> {
    let pixels = Tensor::cat(vec![colors, rays(cameras, frame)], 4); // [B, V, H, W, 6 or 9]
    linear_in_f32(layer, patchify(pixels, patch_size))
}

/// Embeds the rays of target patches.
///
/// # Shapes
/// - returns `[batch * views, num_queries, dim]`
pub fn embed_rays(layer: &Linear, targets: &Cameras, patch_size: usize, frame: RayFrame) -> Tensor<3> {
    let [batch, views] = targets.dims();
    let rays = linear_in_f32(layer, patchify(rays(targets, frame), patch_size)); // [B, TQ, D]
    let [_, queries, dim] = rays.dims();
    rays.reshape([batch * views, queries / views, dim])
}

/// Decodes target patches into images.
///
/// # Shapes
/// - `x`: `[batch * views, num_queries, dim]`
/// - returns RGB in `(0, 1)`, `[batch, views, height, width, 3]`
pub fn decode_image(
    norm: &LayerNorm,
    to_pixels: &Linear,
    x: Tensor<3>,
    targets: &Cameras,
    patch_size: usize,
) -> Tensor<5> {
    let [batch, views] = targets.dims();
    let num_queries = targets.height / patch_size * (targets.width / patch_size);
    let patches = sigmoid(norm_linear(norm, to_pixels, x));
    let [_, _, values] = patches.dims();
    let patches = patches.reshape([batch, views * num_queries, values]);
    unpatchify(patches, [views, targets.height, targets.width], patch_size)
}
