//! Camera information in attention: the transforms of camera-relative attention (GTA, arXiv 2310.10375).
//!
//! Every token has a block-diagonal matrix `rho`, made of the world-to-camera matrix `g` of its view and of rotations by
//! the row and the column of its patch, counted from the principal point: a window of an image has the rotations of the
//! whole. Attention runs on `rho_i^T q_i`, `rho_j^-1 k_j` and `rho_j^-1 v_j`, and `rho_i` is
//! applied to its output. A score then depends on `g_i g_j^-1` alone, the relative pose of two views.
// B scenes, V views, n patches of a view, N = V n tokens, E width of a head, L values of a transform

use burn::tensor::{Tensor, TensorData};

use crate::network::architecture::CameraEncoding;
use crate::network::config::ModelConfig;
use crate::ops::matmul::matmul_without_gradient;
use crate::views::upload::Cameras;

/// Wave lengths of the rotations by row and column, in patches: from `2 pi` to `2 pi * LONGEST`.
const LONGEST: f64 = 100.0;

/// Makes the transform of every patch of every view, in the order of [`patchify`](crate::views::patch::patchify); `None`
/// without camera-relative attention.
///
/// # Shapes
/// - returns `[batch, views * patches, L]`
pub(crate) fn transforms(config: &ModelConfig, cameras: &Cameras) -> Option<Tensor<3>> {
    if config.camera_encoding == CameraEncoding::Plucker {
        return None;
    }
    let [batch, views] = cameras.dims();
    let [rows, columns] = [cameras.height, cameras.width].map(|side| side / config.patch_size);
    let head_width = config.dim / config.num_heads;
    let angles = rotations(cameras, [rows, columns], config.patch_size, head_width / 8);
    let matrices = poses(cameras).reshape([batch, views, 1, 32]).expand([batch, views, rows * columns, 32]);
    let len = 32 + head_width / 2;
    Some(Tensor::cat(vec![matrices, angles], 3).reshape([batch, views * rows * columns, len]))
}

/// Returns cosines, then sines of the angles of every patch, `[B, V, n, E/2]`, at `count` = E/8 frequencies: half of them by its
/// row, half by its column, in patches from the principal point. The angles from the image center are exact; those from there to
/// the principal point are small, and 0 where it is the center.
fn rotations(cameras: &Cameras, [rows, columns]: [usize; 2], patch_size: usize, count: usize) -> Tensor<4> {
    let [batch, views] = cameras.dims();
    let options = (&cameras.intrinsics.device(), cameras.intrinsics.dtype());
    let tensor = |values: Vec<f64>, shape: [usize; 4]| Tensor::<4>::from_data(TensorData::new(values, shape), options);
    let frequencies: Vec<f64> = (0..count).map(|i| LONGEST.powf(-(i as f64) / count as f64)).collect();
    let offset = |axis: usize, side: usize| {
        let point = cameras.intrinsics.clone().narrow(2, axis, 1).reshape([batch, views, 1, 1]);
        let patches = (-point).add_scalar(side as f64 / 2.0).div_scalar(patch_size as f64);
        patches * tensor(frequencies.clone(), [1, 1, 1, count])
    };
    let offset = Tensor::cat(vec![offset(3, cameras.height), offset(2, cameras.width)], 3); // [B, V, 1, E/4]
    let from_center = |patch: usize, num_patches: usize| patch as f64 + 0.5 - num_patches as f64 / 2.0;
    let angles: Vec<f64> = (0..rows * columns)
        .flat_map(|patch| [from_center(patch / columns, rows), from_center(patch % columns, columns)])
        .flat_map(|place| frequencies.iter().map(move |frequency| place * frequency))
        .collect();
    let shape = [1, 1, rows * columns, 2 * count];
    let [cos, sin] = [f64::cos, f64::sin].map(|f| tensor(angles.iter().copied().map(f).collect(), shape));
    let (offset_cos, offset_sin) = (offset.clone().cos(), offset.sin());
    let cosines = cos.clone() * offset_cos.clone() - sin.clone() * offset_sin.clone();
    Tensor::cat(vec![cosines, sin * offset_cos + cos * offset_sin], 3)
}

/// Returns world-to-camera and camera-to-world matrices, `[B, V, 32]`.
fn poses(cameras: &Cameras) -> Tensor<3> {
    let [batch, views] = cameras.dims();
    let flat = |matrix: Tensor<4>| matrix.reshape([batch, views, 16]);
    let c2w = cameras.c2w.clone();
    Tensor::cat(vec![flat(world_to_camera(&c2w)), flat(c2w)], 2)
}

/// Inverts rigid poses, `[B, V, 4, 4]`.
fn world_to_camera(c2w: &Tensor<4>) -> Tensor<4> {
    let rotation = c2w.clone().narrow(2, 0, 3).narrow(3, 0, 3).swap_dims(2, 3);
    let shift = -matmul_without_gradient(rotation.clone(), c2w.clone().narrow(2, 0, 3).narrow(3, 3, 1));
    Tensor::cat(vec![Tensor::cat(vec![rotation, shift], 3), c2w.clone().narrow(2, 3, 1)], 2)
}

#[cfg(test)]
mod tests {
    use burn::tensor::DType;

    use super::*;
    use crate::network::tokens::tracked_as;
    use crate::ops::attention::cross_sdpa;
    use crate::ops::head_transform::{KEY_VALUE, OUTPUT, QUERY, transform_heads};
    use crate::testing::{Fixture, assert_close, devices, output_and_gradients};

    /// Attention of two target views to three context views, as in the fixture.
    fn attend(cameras: [&Cameras; 2], [query, key_value]: [Tensor<3>; 2]) -> Tensor<3> {
        let config =
            ModelConfig { camera_encoding: CameraEncoding::Gta, dim: 32, num_heads: 2, ..ModelConfig::default() };
        let [targets, context] = cameras.map(|cameras| transforms(&config, cameras).expect("camera-relative"));
        let targets = tracked_as(&targets, &query);
        let query = transform_heads(query, targets.clone(), QUERY, 2);
        let key_value = transform_heads(key_value, context, KEY_VALUE, 2);
        transform_heads(cross_sdpa(query, key_value, 2), targets, OUTPUT, 2)
    }

    #[test]
    fn camera_relative_attention_equals_pytorch_in_f32_and_f64() {
        let fixture = Fixture::open("camera_attention");
        // Poses are f32 values, so that their transpose is the inverse to 1e-7 only.
        let wide = devices().into_iter().map(|device| (device, DType::F64, 1e-6));
        let cases = devices().into_iter().map(|device| (device, DType::F32, 1e-5)).chain(wide);
        for (device, dtype, tolerance) in cases {
            let [targets, context] = ["target_", ""].map(|prefix| fixture.cameras(prefix, &device, dtype));
            let read = |name: &str| fixture.tensor_f64::<3>(name, &device).cast(dtype);
            let inputs = ["input.q", "input.key_value"].map(read);
            let attend = |inputs| attend([&targets, &context], inputs);
            let (output, grads) = output_and_gradients(inputs, read("input.cotangent"), attend);
            assert_close(&output, &read("output.gta"), tolerance);
            for (name, grad) in ["q", "key_value"].iter().zip(&grads) {
                assert_close(grad, &read(&format!("grad.gta.{name}")), tolerance);
            }
        }
    }
}
