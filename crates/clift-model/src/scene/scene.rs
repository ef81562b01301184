//! A scene that is kept: its tokens and what the renderer needs beside the weights, as one `.clift` file.
//!
//! The file is safetensors with a header of a fixed length, so that its size is known beforehand
//! ([`scene_file_bytes`]):
//!
//! | part | type | shape |
//! |---|---|---|
//! | length of the header, little-endian | u64 | |
//! | header: JSON with spaces up to [`HEADER_BYTES`] | | |
//! | `context_c2w`, normalised, camera to world | F64 | `[views, 4, 4]` |
//! | `context_intrinsics`: `fx, fy, cx, cy` in pixels | F64 | `[views, 4]` |
//! | `world_mean_c2w`, `world_scale`: the normalisation of poses | F64 | `[4, 4]`, `[1]` |
//! | `token_rays`: `[moment, direction]` through the centre of a token's patch | F32 | `[tokens, 6]` |
//! | `token_scales`, with `int8` tokens only | F32 | `[tokens]` |
//! | `context_frames`: frame of the capture each view is | U32 | `[views]` |
//! | `token_ids`: patch of the context views a token stands on | U32 | `[tokens]` |
//! | `tokens` | F32, F16 or I8 | `[tokens, dim]` |
//!
//! `__metadata__` holds strings: `format` = `clift-scene`, `version`, `key` of the scene, `kind` of its tokens,
//! `model` (sizes and variant of the network as JSON), `renderer` (hash of the weights it is drawn with),
//! `model_path` (where those were), `height` and `width` of the context views.
// S stored tokens, V context views, D width

use crate::network::config::ModelConfig;
use crate::scene::token_format::TokenFormat;
use crate::tokens::kind::TokenKind;
use crate::tokens::selection::token_ray::TokenRay;
use crate::views::camera::ViewCamera;

/// Length of a scene file's header in bytes.
pub const HEADER_BYTES: usize = 2048;

pub(crate) const FORMAT: &str = "clift-scene";
/// 1 named the weights alone, not the number of heads.
pub(crate) const VERSION: &str = "2";

/// How poses of the capture become poses of the scene: `R^T (c - t) * scale` with `[R | t]` the mean pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SceneNormalization {
    /// Mean context camera in the capture's world, camera to world, 4 x 4, row-major.
    pub mean_c2w: [f64; 16],
    /// Normalised units per unit of the capture's world.
    pub scale: f64,
}

/// A compressed scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// Key of the scene in its data.
    pub key: String,
    /// What the tokens are.
    pub kind: TokenKind,
    /// Sizes of the network.
    pub model: ModelConfig,
    /// Hash of the renderer, see [`crate::weights::hash::renderer_hash`].
    pub renderer_hash: String,
    /// The run or weight file it was encoded with, as it was typed: where a renderer is looked for first.
    pub model_path: String,
    /// Rows of the context views, in pixels.
    pub height: usize,
    /// Columns of the context views, in pixels.
    pub width: usize,
    /// Context cameras in the normalised frame.
    pub context: Vec<ViewCamera>,
    /// Frame of the capture each context view is.
    pub context_frames: Vec<u32>,
    /// The normalised frame in the capture's world.
    pub world: SceneNormalization,
    /// The patch each token stands on, `[S]`: `view * rows * columns + row * columns + column`.
    pub token_ids: Vec<u32>,
    /// What the renderer is given, `[S, D]`.
    pub tokens: Vec<f32>,
}

impl Scene {
    /// How many tokens there are.
    pub fn num_tokens(&self) -> usize {
        self.token_ids.len()
    }

    /// The ray of every token, through the centre of its patch.
    ///
    /// # Shapes
    /// - returns `[num_tokens]`
    pub fn token_rays(&self) -> Vec<TokenRay> {
        TokenRay::of_patches(&self.token_ids, &self.context, self.height, self.width, self.model.patch_size)
    }

    /// `[moment, direction]` of every token.
    pub(crate) fn plucker_rays(&self) -> Vec<[f64; 6]> {
        let plucker = |ray: crate::tokens::selection::token_ray::TokenRay| {
            let ([x, y, z], [a, b, c]) = (ray.origin, ray.direction);
            [y * c - z * b, z * a - x * c, x * b - y * a, a, b, c]
        };
        self.token_rays().into_iter().map(plucker).collect()
    }

    /// Bytes of this scene's file.
    pub fn file_bytes(&self, storage: TokenFormat) -> u64 {
        scene_file_bytes(self.num_tokens(), self.model.dim, self.context.len(), storage)
    }
}

/// Bytes of a scene file: `8 + 2048 + 136 + 164 V + S (28 + D b)` with V context views, S tokens of width D and b bytes
/// per value, and four more bytes per token for `int8`.
pub const fn scene_file_bytes(num_tokens: usize, dim: usize, num_views: usize, storage: TokenFormat) -> u64 {
    // c2w and intrinsics in f64 and a frame number.
    let view = (16 + 4) * 8 + 4;
    let world = (16 + 1) * 8;
    // A ray of six f32 and an id.
    let token = 6 * 4 + 4 + storage.bytes_per_token(dim);
    (8 + HEADER_BYTES + world + num_views * view + num_tokens * token) as u64
}

/// Type of the tensor that holds tokens of this format.
pub(crate) const fn dtype_name(storage: TokenFormat) -> &'static str {
    match storage {
        TokenFormat::F32 => "F32",
        TokenFormat::F16 => "F16",
        TokenFormat::Int8 => "I8",
    }
}

#[cfg(test)]
mod tests;
