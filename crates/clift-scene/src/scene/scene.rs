//! A compressed scene: its tokens, and the cameras and sizes that rendering needs besides the weights.
//!
//! A `.clift` file with plain tokens is safetensors with a header of fixed length, so that its size is known in advance
//! ([`scene_file_bytes`]); `coded_file` has the layout of a file with coded tokens:
//!
//! | part | type | shape |
//! |---|---|---|
//! | length of the header, little-endian | u64 | |
//! | header: JSON with spaces up to [`HEADER_BYTES`] | | |
//! | `context_c2w`: normalized poses, camera to world | F64 | `[views, 4, 4]` |
//! | `context_intrinsics`: `fx, fy, cx, cy` in pixels | F64 | `[views, 4]` |
//! | `group_sizes`: number of context views of each group that was encoded together | U32 | `[groups]` |
//! | `group_views`: context views of the groups, one group after the other | U32 | `[members]` |
//! | `group_mean_c2w`, `group_scale`: the frame of each group, as `world_mean_c2w` of normalized poses | F64 | `[groups, 4, 4]`, `[groups]` |
//! | `world_mean_c2w`, `world_scale`: the normalization of poses | F64 | `[4, 4]`, `[1]` |
//! | `token_rays`: `[moment, direction]` through the center of a token's patch in the frame of its group, not of learned tokens | F32 | `[tokens, 6]` |
//! | `token_scales`, with `int8` tokens only | F32 | `[tokens]` |
//! | `context_frames`: frame number of each view in the capture | U32 | `[views]` |
//! | `token_ids`: patch of the members of all groups of each token, not of learned tokens | U32 | `[tokens]` |
//! | `tokens` | F32, F16 or I8 | `[tokens, dim]` |
//!
//! `__metadata__` holds strings: `format` = `clift-scene`, `version`, `key` of the scene, `kind` of its tokens, `model`
//! (sizes and variant of the network as JSON), `renderer` (hash of the renderer's weights), `model_path` (path of the model,
//! relative to the folder of the file or absolute), `height` and `width` of the context views.
// S storage tokens, V context views, G groups, M members of all groups, D width

use clift_core::{Camera, Pose, PoseNormalization};
use clift_model::{ModelConfig, TokenKind, TokenRay};

use crate::scene::token_format::TokenFormat;

/// Length of the header of a scene file in bytes.
pub const HEADER_BYTES: usize = 2048;

/// Most context views whose tokens a view is rendered from, where groups are joined: as many as in training.
pub(crate) const MAX_JOINED_VIEWS: usize = 8;

pub(crate) const FORMAT: &str = "clift-scene";
/// The version of files with plain tokens.
pub(crate) const VERSION: &str = "6";
/// The version of files with coded tokens.
pub(crate) const CODED_VERSION: &str = "7";

/// A compressed scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// Key of the scene in its data set.
    pub key: String,
    /// Kind of the tokens.
    pub kind: TokenKind,
    /// Sizes and variant of the network.
    pub model: ModelConfig,
    /// Hash of the renderer, see [`TrainedModel::renderer_hash`](clift_model::TrainedModel::renderer_hash).
    pub renderer_hash: String,
    /// Path of the run or weight file that encoded the scene, relative to the folder of the scene file, or absolute. See
    /// [`Scene::find_model`].
    pub model_path: String,
    /// Height of the context views in pixels.
    pub height: usize,
    /// Width of the context views in pixels.
    pub width: usize,
    /// Normalized context cameras.
    pub context: Vec<Camera>,
    /// Frame number of each context view in the capture.
    pub context_frames: Vec<u32>,
    /// Groups of context views that were encoded together.
    pub groups: Vec<ContextGroup>,
    /// Normalization of the poses: its frame has the context cameras.
    pub world: PoseNormalization,
    /// Patch of each token, `[S]`: `member * rows * columns + row * columns + column`, where members are counted over all
    /// groups; its index if tokens are learned, whose files do not store it.
    pub token_ids: Vec<u32>,
    /// Values of the tokens after rounding, `[S, D]`.
    pub tokens: Vec<f32>,
}

/// Context views that were encoded together. Their tokens know the cameras in a frame of the group, as in training.
#[derive(Clone, Debug, PartialEq)]
pub struct ContextGroup {
    /// Positions in [`Scene::context`]. A view may be a member of several groups.
    pub views: Vec<u32>,
    /// The normalization of the group's cameras, of poses that [`Scene::world`] has normalized.
    pub frame: PoseNormalization,
}

impl ContextGroup {
    /// Returns the group of all of `num_views` context views, whose frame is that of the scene.
    pub fn of_all(num_views: usize) -> Self {
        Self {
            views: (0..num_views as u32).collect(),
            frame: PoseNormalization { mean_c2w: Pose::IDENTITY, scale: 1.0 },
        }
    }

    /// Maps cameras of the scene to the frame of the group.
    pub fn cameras(&self, cameras: impl IntoIterator<Item = Camera>) -> Vec<Camera> {
        let map = |camera: Camera| Camera { c2w: self.frame.normalize(camera.c2w), ..camera };
        cameras.into_iter().map(map).collect()
    }
}

impl Scene {
    /// Returns the number of tokens.
    pub fn num_tokens(&self) -> usize {
        self.token_ids.len()
    }

    /// Returns the cameras of a group in its frame.
    pub fn group_cameras(&self, group: &ContextGroup) -> Vec<Camera> {
        group.cameras(group.views.iter().map(|&view| self.context[view as usize]))
    }

    /// Returns the number of members of all groups.
    pub fn num_members(&self) -> usize {
        self.groups.iter().map(|group| group.views.len()).sum()
    }

    /// Returns the positions of every group's tokens, ascending. Learned tokens belong to the only group.
    pub fn tokens_of_groups(&self) -> Vec<Vec<u32>> {
        let patches = self.height / self.model.patch_size * (self.width / self.model.patch_size);
        let of_member: Vec<usize> =
            self.groups.iter().enumerate().flat_map(|(i, group)| vec![i; group.views.len()]).collect();
        let mut tokens = vec![Vec::new(); self.groups.len()];
        for (token, &id) in self.token_ids.iter().enumerate() {
            let group = if self.groups.len() == 1 { 0 } else { of_member[id as usize / patches] };
            tokens[group].push(token as u32);
        }
        tokens
    }

    /// Returns the largest number of tokens that one view is rendered from: the tokens of the largest group. A network that joins
    /// groups renders from eight views: their tokens, for the eight views with the most.
    pub fn max_render_tokens(&self) -> usize {
        if !self.model.joins_groups() {
            return self.tokens_of_groups().iter().map(Vec::len).max().unwrap_or_default();
        }
        let mut counts: Vec<usize> = self.tokens_of_members().iter().map(Vec::len).collect();
        counts.sort_unstable_by(|a, b| b.cmp(a));
        counts.iter().take(MAX_JOINED_VIEWS).sum()
    }

    /// Returns the positions of the tokens of every member of all groups, ascending.
    pub(crate) fn tokens_of_members(&self) -> Vec<Vec<u32>> {
        let patches = self.height / self.model.patch_size * (self.width / self.model.patch_size);
        let mut tokens = vec![Vec::new(); self.num_members()];
        for (token, &id) in self.token_ids.iter().enumerate() {
            tokens[id as usize / patches].push(token as u32);
        }
        tokens
    }

    /// Returns the groups whose tokens views are rendered from, with the positions of their tokens: one of all context views
    /// for a network that joins groups.
    pub(crate) fn render_groups(&self) -> Vec<(ContextGroup, Vec<u32>)> {
        if !self.model.joins_groups() {
            return self.groups.iter().cloned().zip(self.tokens_of_groups()).collect();
        }
        let views = self.groups.iter().flat_map(|group| group.views.clone()).collect();
        vec![(ContextGroup { views, ..ContextGroup::of_all(0) }, (0..self.num_tokens() as u32).collect())]
    }

    /// Returns the ray of every token in the frame of its group, through the center of its patch; none of learned tokens.
    ///
    /// # Shapes
    /// - returns `[num_tokens]`, or `[0]`
    pub fn token_rays(&self) -> Vec<TokenRay> {
        let ids = if self.model.has_patch_tokens() { &self.token_ids[..] } else { &[] };
        let members: Vec<Camera> = self.groups.iter().flat_map(|group| self.group_cameras(group)).collect();
        TokenRay::of_patches(ids, &members, self.height, self.width, self.model.patch_size)
    }

    /// Returns `[moment, direction]` of every token's ray.
    pub(crate) fn plucker_rays(&self) -> Vec<[f64; 6]> {
        self.token_rays().iter().map(TokenRay::plucker).collect()
    }

    /// Returns the size of the scene's file in bytes.
    pub fn file_bytes(&self, format: TokenFormat) -> u64 {
        scene_file_bytes(
            &self.model,
            self.num_tokens(),
            (self.context.len(), self.groups.len(), self.num_members()),
            format,
        )
    }
}

/// Splits the members of all groups by the sizes of the groups.
pub(crate) fn split_groups(sizes: &[u32], members: &[u32]) -> Result<Vec<Vec<u32>>, String> {
    let mut rest = members;
    let mut groups = Vec::with_capacity(sizes.len());
    for (group, &size) in sizes.iter().enumerate() {
        let Some((views, others)) = rest.split_at_checked(size as usize) else {
            return Err(format!("group {group} has {size} views, {} are left of {}", rest.len(), members.len()));
        };
        groups.push(views.to_vec());
        rest = others;
    }
    if !rest.is_empty() {
        return Err(format!("{} views after the last group", rest.len()));
    }
    Ok(groups)
}

/// Returns the size of a scene file in bytes: `8 + 2048 + 136 + 164 V + 140 G + 4 M + S (28 + D b)` for V context views, G
/// groups of M members and S tokens of width D with b bytes per value, and four more bytes per token for `int8`. Learned
/// tokens have neither ray nor patch, 28 bytes less.
pub fn scene_file_bytes(
    model: &ModelConfig,
    num_tokens: usize,
    (num_views, num_groups, num_members): (usize, usize, usize),
    format: TokenFormat,
) -> u64 {
    // Pose and intrinsics in f64, and a frame number.
    let view = (16 + 4) * 8 + 4;
    let frame = (16 + 1) * 8;
    // A ray of six f32, and the index of a patch.
    let place = if model.has_patch_tokens() { 6 * 4 + 4 } else { 0 };
    let token = place + format.bytes_per_token(model.dim);
    let groups = num_groups * (frame + 4) + num_members * 4;
    (8 + HEADER_BYTES + frame + num_views * view + groups + num_tokens * token) as u64
}

/// Returns the safetensors type of tokens.
pub(crate) const fn dtype_name(format: TokenFormat) -> &'static str {
    match format {
        TokenFormat::F32 => "F32",
        TokenFormat::F16 => "F16",
        TokenFormat::Int8 => "I8",
    }
}

#[cfg(test)]
pub(crate) mod tests;
