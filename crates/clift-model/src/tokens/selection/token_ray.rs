//! The ray of a stored token.

use clift_core::{Camera, DVec3};

/// The ray through the center of a token's patch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TokenRay {
    /// Center of the camera of the token's view.
    pub origin: DVec3,
    /// Direction, of any length but zero.
    pub direction: DVec3,
}

impl TokenRay {
    /// Returns the rays of patches of context views of `height` by `width` pixels; the id of a patch is
    /// `view * rows * columns + row * columns + column`.
    ///
    /// # Panics
    /// If a view is out of range.
    pub fn of_patches(ids: &[u32], context: &[Camera], height: usize, width: usize, patch_size: usize) -> Vec<Self> {
        let [rows, columns] = [height, width].map(|side| side / patch_size);
        let center = |patch: usize| (patch as f64 + 0.5) * patch_size as f64;
        let ray = |&id: &u32| {
            let id = id as usize;
            let camera = &context[id / (rows * columns)];
            let direction = camera.direction(center(id % columns), center(id / columns % rows));
            Self { origin: camera.c2w.translation, direction }
        };
        ids.iter().map(ray).collect()
    }

    /// Returns `[moment, direction]`.
    pub fn plucker(&self) -> [f64; 6] {
        let ([a, b, c], [x, y, z]) = (self.origin.cross(self.direction).to_array(), self.direction.to_array());
        [a, b, c, x, y, z]
    }
}
