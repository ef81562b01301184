//! The ray of a stored token.

use crate::views::camera::ViewCamera;

/// The ray through the center of a token's patch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TokenRay {
    /// Center of the camera of the token's view.
    pub origin: [f64; 3],
    /// Direction, of any length but zero.
    pub direction: [f64; 3],
}

impl TokenRay {
    /// Returns the rays of patches of context views of `height` by `width` pixels; the id of a patch is
    /// `view * rows * columns + row * columns + column`.
    ///
    /// # Panics
    /// If a view is out of range.
    pub fn of_patches(
        ids: &[u32],
        context: &[ViewCamera],
        height: usize,
        width: usize,
        patch_size: usize,
    ) -> Vec<Self> {
        let [rows, columns] = [height, width].map(|side| side / patch_size);
        let center = |patch: usize| (patch as f64 + 0.5) * patch_size as f64;
        let ray = |&id: &u32| {
            let id = id as usize;
            let camera = &context[id / (rows * columns)];
            let direction = camera.direction(center(id % columns), center(id / columns % rows));
            Self { origin: camera.origin(), direction }
        };
        ids.iter().map(ray).collect()
    }
}
