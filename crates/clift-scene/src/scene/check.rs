//! Rules of a valid scene, checked before a scene is written and after it is read, because files may be hostile.

use clift_core::check_near;
use clift_model::TokenKind;

use crate::scene::scene::Scene;

const MAX_VIEWS: usize = 1024;
/// Longest side of a context view or a rendered image in pixels.
pub const MAX_SIDE_PX: usize = 1 << 14;
/// Most patches of all context views. Every patch is one encoder token.
const MAX_PATCHES: usize = 1 << 20;

impl Scene {
    /// Returns a message about the first invalid field.
    pub(crate) fn check(&self) -> Result<(), String> {
        let num_patches = self.check_views()?;
        self.check_tokens(num_patches)?;
        for (view, camera) in self.context.iter().enumerate() {
            let checked = camera.intrinsics.validate().and_then(|()| camera.c2w.validate());
            let checked = checked.and_then(|()| check_near(&camera.c2w));
            checked.map_err(|error| format!("context camera {view}: {error}"))?;
        }
        for frame in std::iter::once(&self.world).chain(self.groups.iter().map(|group| &group.frame)) {
            frame.mean_c2w.validate().map_err(|error| format!("mean pose: {error}"))?;
            if !(frame.scale > 0.0 && frame.scale.is_finite()) {
                return Err(format!("pose scale {}, expected a positive number", frame.scale));
            }
        }
        if self.renderer_hash.len() != 64 || !self.renderer_hash.bytes().all(|c| c.is_ascii_hexdigit()) {
            return Err(format!("renderer hash {:?}, expected 64 hexadecimal digits", self.renderer_hash));
        }
        Ok(())
    }

    /// Returns the number of patches, or a message about invalid sizes and numbers of views.
    pub(crate) fn check_views(&self) -> Result<usize, String> {
        self.model.validate().map_err(|error| error.to_string())?;
        let views = self.context.len();
        if !(1..=MAX_VIEWS).contains(&views) || self.context_frames.len() != views {
            return Err(format!("{views} context cameras, expected 1 to {MAX_VIEWS}, and as many frame numbers"));
        }
        self.check_groups()?;
        if self.height.max(self.width) > MAX_SIDE_PX {
            return Err(format!(
                "context views of {} x {} pixels, expected at most {MAX_SIDE_PX} a side",
                self.width, self.height
            ));
        }
        let num_patches =
            self.model.num_patches(self.num_members(), self.height, self.width).map_err(|error| error.to_string())?;
        if num_patches > MAX_PATCHES {
            return Err(format!("{num_patches} patches of context views, expected at most {MAX_PATCHES}"));
        }
        Ok(num_patches)
    }

    fn check_groups(&self) -> Result<(), String> {
        let is_size = |count: usize| (1..=MAX_VIEWS).contains(&count);
        if !is_size(self.groups.len()) || !self.groups.iter().all(|group| is_size(group.views.len())) {
            return Err(format!("{} groups of context views, expected 1 to {MAX_VIEWS} with views", self.groups.len()));
        }
        let mut views = self.groups.iter().flat_map(|group| &group.views);
        if let Some(view) = views.find(|view| **view as usize >= self.context.len()) {
            return Err(format!("a group of context view {view}, expected less than {}", self.context.len()));
        }
        if self.groups.len() > 1 && !self.model.has_patch_tokens() {
            return Err(format!("{} groups of learned tokens, expected one", self.groups.len()));
        }
        Ok(())
    }

    fn check_tokens(&self, num_patches: usize) -> Result<(), String> {
        let (count, dim) = (self.num_tokens(), self.model.dim);
        if self.model.architecture.supports_clusters() == (self.kind == TokenKind::All) {
            return Err(format!("{} tokens of a network of {}", self.kind, self.model.architecture));
        }
        // The places of learned tokens are their indices.
        let num_patches = match self.model.num_learned_tokens() {
            Some(all) if !self.token_ids.iter().copied().eq(0..all as u32) => {
                return Err(format!("{count} tokens, expected all {all} learned tokens in order"));
            }
            Some(all) => all,
            None => num_patches,
        };
        if !(1..=num_patches).contains(&count) {
            return Err(format!("{count} tokens, expected 1 to {num_patches}, the number of patches"));
        }
        if self.tokens.len() != count * dim {
            return Err(format!("{} values of {count} tokens of width {dim}", self.tokens.len()));
        }
        if let Some(position) = self.tokens.iter().position(|value| !value.is_finite()) {
            return Err(format!("token {} contains {}", position / dim, self.tokens[position]));
        }
        let mut seen = vec![false; num_patches];
        for (token, &id) in self.token_ids.iter().enumerate() {
            match seen.get_mut(id as usize) {
                Some(seen) if !*seen => *seen = true,
                Some(_) => return Err(format!("two tokens of patch {id}, the second is token {token}")),
                None => return Err(format!("token {token} of patch {id}, expected less than {num_patches}")),
            }
        }
        Ok(())
    }
}
