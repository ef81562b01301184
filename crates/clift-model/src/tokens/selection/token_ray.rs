//! Ray of a stored token.

use crate::views::camera::ViewCamera;

/// The ray through the centre of a token's patch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TokenRay {
    /// Centre of the camera whose view the token is of.
    pub origin: [f64; 3],
    /// Of any length but zero.
    pub direction: [f64; 3],
}

impl TokenRay {
    /// The rays through the centres of patches of context views of `height` by `width` pixels; patch
    /// `view * rows * columns + row * columns + column`.
    ///
    /// # Panics
    /// For a patch of a view that is not there.
    pub fn of_patches(
        ids: &[u32],
        context: &[ViewCamera],
        height: usize,
        width: usize,
        patch_size: usize,
    ) -> Vec<Self> {
        let [rows, columns] = [height, width].map(|side| side / patch_size);
        let centre = |patch: usize| (patch as f64 + 0.5) * patch_size as f64;
        let ray = |&id: &u32| {
            let id = id as usize;
            let camera = &context[id / (rows * columns)];
            let direction = camera.direction(centre(id % columns), centre(id / columns % rows));
            Self { origin: camera.origin(), direction }
        };
        ids.iter().map(ray).collect()
    }
}
