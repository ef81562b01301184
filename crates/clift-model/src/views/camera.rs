//! A pinhole camera on the host, and the ray of any point of its image.

use burn::tensor::Device;

use crate::error::ModelError;
use crate::views::upload::Cameras;

/// A pinhole camera in the normalized frame of a scene, OpenCV axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ViewCamera {
    /// Camera to world, 4 x 4, row-major.
    pub c2w: [f64; 16],
    /// `fx, fy, cx, cy` in pixels.
    pub intrinsics: [f64; 4],
}

impl ViewCamera {
    /// Returns the center of the camera.
    pub fn origin(&self) -> [f64; 3] {
        [3, 7, 11].map(|i| self.c2w[i])
    }

    /// Returns the unit direction in which the camera looks.
    pub fn axis(&self) -> [f64; 3] {
        [2, 6, 10].map(|i| self.c2w[i])
    }

    /// Returns the unit direction through column `x` and row `y` of the image, in pixels; the center of pixel (i, j) is
    /// (i + 0.5, j + 0.5).
    pub fn direction(&self, x: f64, y: f64) -> [f64; 3] {
        let [fx, fy, cx, cy] = self.intrinsics;
        let ray = [(x - cx) / fx, (y - cy) / fy, 1.0];
        // The third coordinate is 1, so that the length is at least 1.
        let length = ray.iter().map(|v| v * v).sum::<f64>().sqrt();
        [0, 4, 8].map(|row| (0..3).map(|i| self.c2w[row + i] * ray[i]).sum::<f64>() / length)
    }

    /// Returns the camera for an image of another size. Focal lengths scale with the height, which preserves the vertical
    /// field of view; the offset of the principal point from the image center scales likewise.
    ///
    /// `from` and `to` are `[height, width]` in pixels.
    #[must_use]
    pub fn resized(&self, from: [usize; 2], to: [usize; 2]) -> Self {
        let [from_height, from_width] = from.map(|side| side as f64);
        let [height, width] = to.map(|side| side as f64);
        let scale = height / from_height;
        let [fx, fy, cx, cy] = self.intrinsics;
        let (cx, cy) = ((cx - from_width / 2.0) * scale + width / 2.0, (cy - from_height / 2.0) * scale + height / 2.0);
        Self { intrinsics: [fx * scale, fy * scale, cx, cy], ..*self }
    }
}

impl Cameras {
    /// Copies the cameras of one scene to a device.
    ///
    /// # Errors
    /// As [`Cameras::upload`].
    pub fn of_views(views: &[ViewCamera], height: usize, width: usize, device: &Device) -> Result<Self, ModelError> {
        let c2w: Vec<f32> = views.iter().flat_map(|view| view.c2w).map(|value| value as f32).collect();
        let intrinsics: Vec<f32> = views.iter().flat_map(|view| view.intrinsics).map(|value| value as f32).collect();
        Self::upload(&c2w, &intrinsics, [1, views.len(), height, width], device)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::to_vec;
    use crate::views::rays::plucker;

    /// Returns a camera at (0.5, -0.2, 0.1), rotated by 0.3 about y.
    fn camera() -> ViewCamera {
        let (sin, cos) = 0.3_f64.sin_cos();
        ViewCamera {
            c2w: [cos, 0.0, sin, 0.5, 0.0, 1.0, 0.0, -0.2, -sin, 0.0, cos, 0.1, 0.0, 0.0, 0.0, 1.0],
            intrinsics: [20.0, 22.0, 8.5, 4.0],
        }
    }

    #[test]
    fn origin_and_directions_equal_the_plucker_rays() {
        let cameras = Cameras::of_views(&[camera()], 8, 16, &Device::flex()).expect("valid");
        let rays = to_vec(plucker(&cameras)); // [1, 1, 8, 16, 6]
        let [x, y, z] = camera().origin();
        for (i, ray) in rays.chunks(6).enumerate() {
            let [a, b, c] = camera().direction((i % 16) as f64 + 0.5, (i / 16) as f64 + 0.5);
            let expected = [y * c - z * b, z * a - x * c, x * b - y * a, a, b, c];
            for (got, expected) in ray.iter().zip(expected) {
                assert!((got - expected).abs() < 1e-6, "pixel {i}: {got} against {expected}"); // f32
            }
        }
    }

    #[test]
    fn resizing_preserves_the_vertical_field_of_view() {
        let large = camera().resized([8, 16], [16, 48]);
        assert_eq!(large.intrinsics, [40.0, 44.0, 25.0, 8.0]);
        assert_eq!(camera().resized([8, 16], [8, 16]), camera());
        for (small_y, large_y) in [(0.0, 0.0), (8.0, 16.0)] {
            let (a, b) = (camera().direction(8.0, small_y), large.direction(24.0, large_y));
            assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12), "{a:?} {b:?}");
        }
    }
}
