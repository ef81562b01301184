//! A compressed scene: its tokens, and the cameras and sizes that rendering needs besides the weights.
//!
//! A `.clift` file with plain tokens is safetensors with a header of fixed length ([`HEADER_BYTES`], filled with spaces), so that
//! its size is known in advance ([`scene_file_bytes`]); `coded_file` has the other layout. `docs/reference/files.md` describes
//! the tensors, whose types and shapes [`Scene::write`] lists.
// S storage tokens, V context views, G groups, M members of all groups, D width

use std::path::{Component, Path, PathBuf};

use clift_core::{Camera, ClipViews, Pose, PoseNormalization, folder_of};
use clift_model::{ModelConfig, SHIPPED_MODEL, TokenKind, TokenRay};

use crate::scene::token_coding::TokenFormat;

/// Length of the header of a scene file in bytes.
pub const HEADER_BYTES: usize = 2048;

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

    /// Returns the views of the group, with cameras in its frame, of all context views.
    pub(crate) fn members(&self, context: &ClipViews) -> ClipViews {
        let len = context.height * context.width * 3;
        let views = || self.views.iter().map(|&view| view as usize);
        ClipViews {
            images: views().flat_map(|view| &context.images[view * len..][..len]).copied().collect(),
            cameras: self.cameras(views().map(|view| context.cameras[view])),
            frame_index: views().map(|view| context.frame_index[view]).collect(),
            ..*context
        }
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

    /// Returns the largest number of tokens that one view is rendered from: the tokens of the largest group.
    pub fn max_render_tokens(&self) -> usize {
        self.tokens_of_groups().iter().map(Vec::len).max().unwrap_or_default()
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

    pub(crate) fn plucker_rays(&self) -> Vec<[f64; 6]> {
        self.token_rays().iter().map(TokenRay::plucker).collect()
    }

    /// Returns the size of the scene's file in bytes.
    pub fn file_bytes(&self, format: TokenFormat) -> u64 {
        let counts = (self.context.len(), self.groups.len(), self.num_members());
        scene_file_bytes(&self.model, self.num_tokens(), counts, format)
    }

    /// Returns the `model_path` of a scene file at `file`: relative to the folder of the file for a relative `model`, so that
    /// both can be moved together and read from any folder; an absolute `model` as it is.
    pub fn model_path_for(model: &Path, file: &Path) -> String {
        let relative = || {
            let from = folder_of(file).canonicalize().ok()?;
            let to = model.canonicalize().ok()?;
            let shared = from.components().zip(to.components()).take_while(|(a, b)| a == b).count();
            let up = from.components().skip(shared).map(|_| Component::ParentDir);
            let path: PathBuf = up.chain(to.components().skip(shared)).collect();
            Some(path)
        };
        let path = if model.is_absolute() { None } else { relative() };
        path.unwrap_or_else(|| model.into()).to_string_lossy().into_owned()
    }

    /// Returns the path of the model of the scene that was read from `file`. A relative model path starts at the folder of
    /// the file. The path need not exist. A missing `models/rooms` is the [shipped model](clift_model::find_shipped).
    pub fn find_model(&self, file: &Path) -> PathBuf {
        find_model(&self.model_path, file)
    }
}

pub(crate) fn find_model(model_path: &str, file: &Path) -> PathBuf {
    let path = folder_of(file).join(model_path);
    // The scene may come from a machine that has the repository.
    if path.ends_with(SHIPPED_MODEL) && !path.exists() { SHIPPED_MODEL.into() } else { path }
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
/// groups of M members and S tokens of width D with b bytes per value. Learned tokens have neither ray nor patch, 28 bytes
/// less.
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

pub(crate) const fn dtype_name(format: TokenFormat) -> &'static str {
    match format {
        TokenFormat::F32 => "F32",
        TokenFormat::F16 => "F16",
    }
}

#[cfg(test)]
pub(crate) mod tests;
