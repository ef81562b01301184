//! Camera information in attention: the transforms of camera-relative attention (GTA, arXiv 2310.10375; `PRoPE`,
//! arXiv 2507.10496).
//!
//! Every token has a block-diagonal matrix `rho`, made of the world-to-camera matrix `g` of its view and of rotations by
//! the row and the column of its patch, counted from the principal point: a window of an image has the rotations of the
//! whole. Attention runs on `rho_i^T q_i`, `rho_j^-1 k_j` and `rho_j^-1 v_j`, and `rho_i` is
//! applied to its output. A score then depends on `g_i g_j^-1` alone, the relative pose of two views.
// B scenes, V views, n patches of a view, N = V n tokens, E width of a head, L values of a transform

use burn::tensor::{Device, Int, Tensor, TensorData};

use crate::network::architecture::CameraEncoding;
use crate::network::config::ModelConfig;
use crate::ops::head_transform::{KEY_VALUE, OUTPUT, QUERY, QUERY_KEY_VALUE, transform_heads};
use crate::ops::matmul::matmul_without_gradient;
use crate::views::upload::Cameras;

/// Wave lengths of the rotations by row and column, in patches: from `2 pi` to `2 pi * LONGEST`.
const LONGEST: f64 = 100.0;

/// Makes the transforms of tokens from cameras.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TransformMaker {
    encoding: CameraEncoding,
    head_width: usize,
    patch_size: usize,
}

/// The transforms of tokens, `[batch, count, L]`.
#[derive(Clone, Debug)]
pub struct TokenTransforms(Tensor<3>);

impl TransformMaker {
    /// Takes the encoding and the sizes of a network.
    pub fn new(config: &ModelConfig) -> Self {
        let ModelConfig { camera_encoding: encoding, dim, num_heads, patch_size, .. } = *config;
        Self { encoding, head_width: dim / num_heads, patch_size }
    }

    /// Whether attention is camera-relative.
    pub fn is_camera_relative(&self) -> bool {
        self.encoding != CameraEncoding::Plucker
    }

    /// Makes the transform of every patch of every view, in the order of
    /// [`patchify`](crate::views::patch::patchify); `None` without camera-relative attention.
    ///
    /// # Shapes
    /// - returns `[batch, views * patches, L]`
    pub fn of_views(&self, cameras: &Cameras) -> Option<TokenTransforms> {
        let matrices = match self.encoding {
            CameraEncoding::Plucker => return None,
            CameraEncoding::Gta => poses(cameras),
            CameraEncoding::Prope => projections(cameras),
        };
        let [batch, views] = cameras.dims();
        let [rows, columns] = [cameras.height, cameras.width].map(|side| side / self.patch_size);
        let angles = self.rotations(cameras, rows, columns);
        let matrices = matrices.reshape([batch, views, 1, 32]).expand([batch, views, rows * columns, 32]);
        let len = 32 + self.head_width / 2;
        Some(TokenTransforms(Tensor::cat(vec![matrices, angles], 3).reshape([batch, views * rows * columns, len])))
    }

    /// Returns cosines, then sines of the angles of every patch, `[B, V, n, E/2]`: half of them by its row, half by its
    /// column, in patches from the principal point. The angles from the image center are exact; those from there to the
    /// principal point are small, and 0 where it is the center.
    fn rotations(&self, cameras: &Cameras, rows: usize, columns: usize) -> Tensor<4> {
        let [batch, views] = cameras.dims();
        let count = self.head_width / 8;
        let options = (&cameras.intrinsics.device(), cameras.intrinsics.dtype());
        let tensor =
            |values: Vec<f64>, shape: [usize; 4]| Tensor::<4>::from_data(TensorData::new(values, shape), options);
        let frequencies: Vec<f64> = (0..count).map(|i| LONGEST.powf(-(i as f64) / count as f64)).collect();
        let offset = |axis: usize, side: usize| {
            let point = cameras.intrinsics.clone().narrow(2, axis, 1).reshape([batch, views, 1, 1]);
            let patches = (-point).add_scalar(side as f64 / 2.0).div_scalar(self.patch_size as f64);
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
}

/// Returns world-to-camera and camera-to-world matrices, `[B, V, 32]`.
fn poses(cameras: &Cameras) -> Tensor<3> {
    let [batch, views] = cameras.dims();
    let flat = |matrix: Tensor<4>| matrix.reshape([batch, views, 16]);
    let c2w = cameras.c2w.clone();
    Tensor::cat(vec![flat(world_to_camera(&c2w)), flat(c2w)], 2)
}

/// Returns `K [R | t]` and its inverse, with intrinsics `K` in units of the image size and the principal point relative to
/// the center, `[B, V, 32]`.
fn projections(cameras: &Cameras) -> Tensor<3> {
    let [batch, views] = cameras.dims();
    let sizes = [cameras.width, cameras.height].map(|side| side as f64);
    let value = |index: usize| {
        let value = cameras.intrinsics.clone().narrow(2, index, 1).reshape([batch, views, 1, 1]);
        value.mul_scalar(1.0 / sizes[index % 2])
    };
    let [fx, fy] = [0, 1].map(value);
    let [cx, cy] = [2, 3].map(|index| value(index).sub_scalar(0.5));
    let (one, zero) = (fx.ones_like(), fx.zeros_like());
    let matrix = |[fx, cx, fy, cy]: [&Tensor<4>; 4]| {
        let rows = [fx, &zero, cx, &zero, &zero, fy, cy, &zero, &zero, &zero, &one, &zero, &zero, &zero, &zero, &one];
        Tensor::cat(rows.map(Tensor::clone).into(), 3).reshape([batch, views, 4, 4])
    };
    let forward = matmul_without_gradient(matrix([&fx, &cx, &fy, &cy]), world_to_camera(&cameras.c2w));
    let inverse = matrix([&fx.clone().recip(), &-(cx / fx), &fy.clone().recip(), &-(cy / fy)]);
    let backward = matmul_without_gradient(cameras.c2w.clone(), inverse);
    let flat = |matrix: Tensor<4>| matrix.reshape([batch, views, 16]);
    Tensor::cat(vec![flat(forward), flat(backward)], 2)
}

/// Copies the indices of tokens to a device.
pub(crate) fn upload_ids(ids: &[u32], device: &Device) -> Tensor<1, Int> {
    let ids: Vec<i64> = ids.iter().map(|&id| i64::from(id)).collect();
    let count = ids.len();
    Tensor::from_data(TensorData::new(ids, [count]), device)
}

/// Inverts rigid poses, `[B, V, 4, 4]`.
fn world_to_camera(c2w: &Tensor<4>) -> Tensor<4> {
    let rotation = c2w.clone().narrow(2, 0, 3).narrow(3, 0, 3).swap_dims(2, 3);
    let shift = -matmul_without_gradient(rotation.clone(), c2w.clone().narrow(2, 0, 3).narrow(3, 3, 1));
    Tensor::cat(vec![Tensor::cat(vec![rotation, shift], 3), c2w.clone().narrow(2, 3, 1)], 2)
}

impl TokenTransforms {
    /// Returns the transforms in another type or on another device.
    #[must_use]
    pub fn map(&self, f: impl FnOnce(&Tensor<3>) -> Tensor<3>) -> Self {
        Self(f(&self.0))
    }

    /// Selects rows of the transforms of all scenes, `[batch * count, L]`, for `groups` sequences of equal length.
    #[must_use]
    pub(crate) fn gather(&self, rows: Tensor<1, Int>, groups: usize) -> Self {
        let [batch, count, len] = self.0.dims();
        let [num_rows] = rows.dims();
        Self(self.0.clone().reshape([batch * count, len]).select(0, rows).reshape([groups, num_rows / groups, len]))
    }

    /// Selects the same tokens of every scene.
    #[must_use]
    pub(crate) fn select(&self, ids: &[u32]) -> Self {
        Self(self.0.clone().select(1, upload_ids(ids, &self.0.device())))
    }

    /// Divides the tokens of every scene into `groups` sequences in all.
    #[must_use]
    pub(crate) fn regroup(&self, groups: usize) -> Self {
        let [batch, count, len] = self.0.dims();
        Self(self.0.clone().reshape([groups, batch * count / groups, len]))
    }

    /// Returns the transforms without or with autodiff.
    #[must_use]
    pub(crate) fn tracked_as(&self, other: &Tensor<3>) -> Self {
        Self(match (self.0.is_autodiff(), other.is_autodiff()) {
            (false, true) => self.0.clone().autodiff(),
            (true, false) => self.0.clone().inner(),
            _ => self.0.clone(),
        })
    }

    /// Transforms queries, keys and values side by side, `[batch, count, 3 dim]`.
    pub(crate) fn query_key_value(&self, x: Tensor<3>, num_heads: usize) -> Tensor<3> {
        transform_heads(x, self.0.clone(), QUERY_KEY_VALUE, num_heads)
    }

    /// Transforms queries, `[batch, count, dim]`.
    pub(crate) fn query(&self, x: Tensor<3>, num_heads: usize) -> Tensor<3> {
        transform_heads(x, self.0.clone(), QUERY, num_heads)
    }

    /// Transforms keys and values side by side, `[batch, count, 2 dim]`.
    pub(crate) fn key_value(&self, x: Tensor<3>, num_heads: usize) -> Tensor<3> {
        transform_heads(x, self.0.clone(), KEY_VALUE, num_heads)
    }

    /// Transforms the output of attention, `[batch, count, dim]`, back to the frame of its query.
    pub(crate) fn output(&self, x: Tensor<3>, num_heads: usize) -> Tensor<3> {
        transform_heads(x, self.0.clone(), OUTPUT, num_heads)
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::DType;

    use super::*;
    use crate::ops::attention::cross_sdpa;
    use crate::testing::{Fixture, assert_close, devices, output_and_gradients};

    fn maker(encoding: CameraEncoding) -> TransformMaker {
        let config = ModelConfig { camera_encoding: encoding, dim: 32, num_heads: 2, ..ModelConfig::default() };
        TransformMaker::new(&config)
    }

    /// Attention of two target views to three context views, as in the fixture.
    fn attend(encoding: CameraEncoding, cameras: [&Cameras; 2], [query, key_value]: [Tensor<3>; 2]) -> Tensor<3> {
        let [targets, context] = cameras.map(|cameras| maker(encoding).of_views(cameras).expect("camera-relative"));
        let (query, key_value) = (targets.tracked_as(&query).query(query, 2), context.key_value(key_value, 2));
        targets.output(cross_sdpa(query, key_value, 2), 2)
    }

    #[test]
    fn camera_relative_attention_equals_pytorch_in_f32_and_f64() {
        let fixture = Fixture::open("camera_attention");
        // Poses are f32 values, so that their transpose is the inverse to 1e-7 only.
        let wide = devices().into_iter().map(|device| (device, DType::F64, 1e-6));
        let cases = devices().into_iter().map(|device| (device, DType::F32, 1e-5)).chain(wide);
        for (device, dtype, tolerance) in cases {
            let cameras = |prefix: &str| Cameras {
                height: 16,
                width: 24,
                c2w: fixture.tensor_f64::<4>(&format!("input.{prefix}c2w"), &device).cast(dtype),
                intrinsics: fixture.tensor_f64::<3>(&format!("input.{prefix}intrinsics"), &device).cast(dtype),
            };
            let (targets, context) = (cameras("target_"), cameras(""));
            let read = |name: &str| fixture.tensor_f64::<3>(name, &device).cast(dtype);
            for encoding in [CameraEncoding::Gta, CameraEncoding::Prope] {
                let inputs = ["input.q", "input.key_value"].map(read);
                let attend = |inputs| attend(encoding, [&targets, &context], inputs);
                let (output, grads) = output_and_gradients(inputs, read("input.cotangent"), attend);
                assert_close(&output, &read(&format!("output.{encoding}")), tolerance);
                for (name, grad) in ["q", "key_value"].iter().zip(&grads) {
                    assert_close(grad, &read(&format!("grad.{encoding}.{name}")), tolerance);
                }
            }
        }
    }
}
