//! Pinhole intrinsics and posed cameras in f64.

use glam::DVec3;

use crate::error::CameraError;
use crate::geometry::pose::Pose;

/// Pinhole intrinsics in pixels of one image. The centre of the pixel in column `i` and row `j` is
/// `(i + 0.5, j + 0.5)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics {
    /// Horizontal focal length in pixels.
    pub fx: f64,
    /// Vertical focal length in pixels.
    pub fy: f64,
    /// Column of the principal point in pixels.
    pub cx: f64,
    /// Row of the principal point in pixels.
    pub cy: f64,
}

/// Pinhole intrinsics divided by the image's width (`fx`, `cx`) and height (`fy`, `cy`), as in files.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct IntrinsicsNorm {
    /// Horizontal focal length over the width.
    pub fx: f64,
    /// Vertical focal length over the height.
    pub fy: f64,
    /// Column of the principal point over the width.
    pub cx: f64,
    /// Row of the principal point over the height.
    pub cy: f64,
}

impl Intrinsics {
    /// Returns `fx, fy, cx, cy`.
    pub fn to_array(self) -> [f64; 4] {
        let Self { fx, fy, cx, cy } = self;
        [fx, fy, cx, cy]
    }

    /// Checks that focal lengths are positive and all numbers finite.
    pub fn validate(self) -> Result<(), CameraError> {
        let Self { fx, fy, cx, cy } = self;
        let [focal, centre] = ["a positive number", "a finite number"];
        for (name, value, expected) in [("fx", fx, focal), ("fy", fy, focal), ("cx", cx, centre), ("cy", cy, centre)] {
            if !value.is_finite() || (expected == focal && value <= 0.0) {
                return Err(CameraError::BadCamera { what: format!("{name} is {value}, expected {expected}") });
            }
        }
        Ok(())
    }
}

impl From<[f64; 4]> for Intrinsics {
    /// Converts `fx, fy, cx, cy`.
    fn from([fx, fy, cx, cy]: [f64; 4]) -> Self {
        Self { fx, fy, cx, cy }
    }
}

impl IntrinsicsNorm {
    /// Returns `fx, fy, cx, cy`.
    pub fn to_array(self) -> [f64; 4] {
        let Self { fx, fy, cx, cy } = self;
        [fx, fy, cx, cy]
    }

    /// Checks that focal lengths are positive and all numbers finite.
    pub fn validate(self) -> Result<(), CameraError> {
        Intrinsics::from(self.to_array()).validate()
    }

    /// Divides `intrinsics` in pixels by the size of their image, in pixels.
    pub fn from_pixels(intrinsics: Intrinsics, width: f64, height: f64) -> Self {
        let Intrinsics { fx, fy, cx, cy } = intrinsics;
        Self { fx: fx / width, fy: fy / height, cx: cx / width, cy: cy / height }
    }

    /// Returns the intrinsics in pixels of an image of `width` by `height` pixels.
    pub fn to_pixels(self, width: usize, height: usize) -> Intrinsics {
        let (width, height) = (width as f64, height as f64);
        Intrinsics { fx: self.fx * width, fy: self.fy * height, cx: self.cx * width, cy: self.cy * height }
    }
}

/// A posed pinhole camera, OpenCV axes: with intrinsics in pixels of its image, or `Camera<IntrinsicsNorm>` of an image of
/// any size, as data sets have it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera<K = Intrinsics> {
    /// Camera-to-world pose.
    pub c2w: Pose,
    /// Intrinsics.
    pub intrinsics: K,
}

impl Camera {
    /// Returns the unit direction in the world through column `x` and row `y` of the image, in pixels.
    pub fn direction(&self, x: f64, y: f64) -> DVec3 {
        let Intrinsics { fx, fy, cx, cy } = self.intrinsics;
        let ray = DVec3::new((x - cx) / fx, (y - cy) / fy, 1.0);
        self.c2w.rotation * ray / ray.length()
    }

    /// Returns the camera for an image of another size. Focal lengths scale with the height, which preserves the vertical
    /// field of view; the offset of the principal point from the image centre scales likewise.
    ///
    /// `from` and `to` are `[height, width]` in pixels.
    #[must_use]
    pub fn resized(&self, from: [usize; 2], to: [usize; 2]) -> Self {
        let [from_height, from_width] = from.map(|side| side as f64);
        let [height, width] = to.map(|side| side as f64);
        let scale = height / from_height;
        let Intrinsics { fx, fy, cx, cy } = self.intrinsics;
        let intrinsics = Intrinsics {
            fx: fx * scale,
            fy: fy * scale,
            cx: (cx - from_width / 2.0) * scale + width / 2.0,
            cy: (cy - from_height / 2.0) * scale + height / 2.0,
        };
        Self { intrinsics, ..*self }
    }
}

impl Camera<IntrinsicsNorm> {
    /// Converts the 18 numbers of a RealEstate10K frame: `fx fy cx cy` over width and height, two placeholders
    /// (ignored), then `w2c` as 3 x 4, row-major, OpenCV axes. `c2w` is the matrix inverse of `w2c`.
    pub fn from_re10k(row: [f64; 18]) -> Result<Self, CameraError> {
        let [fx, fy, cx, cy, ..] = row;
        let intrinsics = IntrinsicsNorm { fx, fy, cx, cy };
        intrinsics.validate()?;
        let w2c = Pose::from_rows(&[0, 1, 2].map(|r| [0, 1, 2, 3].map(|c| row[6 + 4 * r + c])))?;
        Ok(Self { intrinsics, c2w: w2c.matrix_inverse() })
    }

    /// Returns the 18 numbers that [`Camera::from_re10k`] reads, with zeros for the placeholders.
    pub fn to_re10k(&self) -> [f64; 18] {
        let mut row = [0.0; 18];
        row[..4].copy_from_slice(&self.intrinsics.to_array());
        row[6..].copy_from_slice(&self.c2w.matrix_inverse().to_matrix_f64()[..12]);
        row
    }

    /// Returns the horizontal and the vertical field of view in degrees: the angles between the rays through the
    /// midpoints of opposite image edges, as pixelSplat's filter computes them.
    pub fn fov_deg(&self) -> (f64, f64) {
        let IntrinsicsNorm { fx, fy, cx, cy } = self.intrinsics;
        let ray = |u: f64, v: f64| DVec3::new((u - cx) / fx, (v - cy) / fy, 1.0);
        (angle_deg(ray(0.0, 0.5), ray(1.0, 0.5)), angle_deg(ray(0.5, 0.0), ray(0.5, 1.0)))
    }
}

/// Returns the largest field of view of the cameras along either axis, in degrees; 0 for no cameras.
pub fn widest_fov_deg(cameras: &[Camera<IntrinsicsNorm>]) -> f64 {
    cameras.iter().map(Camera::fov_deg).fold(0.0, |widest, (x, y)| widest.max(x).max(y))
}

/// Returns the angle in degrees. `atan2` is accurate for small angles, where `acos` loses half the digits.
fn angle_deg(a: DVec3, b: DVec3) -> f64 {
    a.cross(b).length().atan2(a.dot(b)).to_degrees()
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;

    /// Row of a camera at (1, 2, 3) that looks along world +x: its right is world -z, its down is world +y.
    /// By hand: w2c rotation has rows right, down, forward; w2c translation is -R (1, 2, 3) = (3, -2, -1).
    const LOOKS_ALONG_X: [f64; 18] = [
        0.9, 1.6, 0.5, 0.25, 0.0, 0.0, // fx fy cx cy and the placeholders
        0.0, 0.0, -1.0, 3.0, // right
        0.0, 1.0, 0.0, -2.0, // down
        1.0, 0.0, 0.0, -1.0, // forward
    ];

    #[test]
    fn re10k_row_matches_the_camera_computed_by_hand() {
        let camera = Camera::from_re10k(LOOKS_ALONG_X).unwrap();
        assert_eq!(camera.intrinsics, IntrinsicsNorm { fx: 0.9, fy: 1.6, cx: 0.5, cy: 0.25 });
        assert_eq!(camera.c2w.translation, DVec3::new(1.0, 2.0, 3.0));
        assert_eq!(camera.c2w.rotation.z_axis, DVec3::X);
        assert_eq!(camera.c2w.rotation.x_axis, -DVec3::Z);
        let pixels = camera.intrinsics.to_pixels(640, 360);
        assert_eq!(pixels, Intrinsics { fx: 576.0, fy: 576.0, cx: 320.0, cy: 90.0 });
    }

    #[test]
    fn re10k_row_with_rounded_rotation_round_trips() {
        // A rotation rounded to three decimals: its transpose is not its inverse.
        let mut row = LOOKS_ALONG_X;
        row[6..18].copy_from_slice(&[0.866, -0.5, 0.0, 10.0, 0.5, 0.866, 0.0, -20.0, 0.0, 0.0, 1.0, 30.0]);
        let back = Camera::from_re10k(row).unwrap().to_re10k();
        for (got, expected) in back.iter().zip(&row) {
            assert!((got - expected).abs() < 1e-13, "{got} against {expected}"); // a few roundings of 30
        }
    }

    #[test]
    fn focal_length_of_half_the_width_is_90_degrees() {
        let mut row = LOOKS_ALONG_X;
        row[..4].copy_from_slice(&[0.5, 1.0, 0.5, 0.5]);
        let (x, y) = Camera::from_re10k(row).unwrap().fov_deg();
        assert!((x - 90.0).abs() < 1e-12 && (y - 53.130_102_354_155_98).abs() < 1e-12, "{x} {y}"); // 2 atan(1/2)
    }

    #[test]
    fn invalid_row_names_the_first_invalid_number() {
        for (index, value, expected) in [
            (1, -0.5, "bad camera: fy is -0.5, expected a positive number"),
            (3, f64::INFINITY, "bad camera: cy is inf, expected a finite number"),
            (9, f64::NEG_INFINITY, "bad camera: the pose holds -inf"),
            (11, -1.0, "mirrors"),
            (11, 2.0, "off an orthonormal one by 3.000e0"),
        ] {
            let mut row = LOOKS_ALONG_X;
            row[index] = value;
            let message = Camera::from_re10k(row).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }

    fn turned() -> Camera {
        let c2w = Pose { rotation: DMat3::from_rotation_y(0.3), translation: DVec3::new(0.5, -0.2, 0.1) };
        Camera { c2w, intrinsics: Intrinsics { fx: 20.0, fy: 22.0, cx: 8.5, cy: 4.0 } }
    }

    #[test]
    fn resizing_preserves_the_vertical_field_of_view() {
        let large = turned().resized([8, 16], [16, 48]);
        assert_eq!(large.intrinsics, Intrinsics { fx: 40.0, fy: 44.0, cx: 25.0, cy: 8.0 });
        assert_eq!(turned().resized([8, 16], [8, 16]), turned());
        for (small_y, large_y) in [(0.0, 0.0), (8.0, 16.0)] {
            let (a, b) = (turned().direction(8.0, small_y), large.direction(24.0, large_y));
            assert!(a.abs_diff_eq(b, 1e-12), "{a} {b}");
        }
    }
}
