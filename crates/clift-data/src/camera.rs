//! Cameras in f64: intrinsics, rigid poses, and the conversions between file conventions.
//!
//! Axes are OpenCV's: +x right, +y down, +z forward. A pose is always named after its direction,
//! `c2w` (camera to world) or `w2c` (world to camera).

use crate::error::DataError;

/// Pinhole intrinsics in pixels of the current image; pixel `(column i, row j)` has its centre at
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

/// Pinhole intrinsics divided by the image's width (`fx`, `cx`) and height (`fy`, `cy`), as files hold them.
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

impl IntrinsicsNorm {
    /// Checks that a picture can have been taken with them.
    ///
    /// # Errors
    /// [`DataError::BadCamera`] when a focal length is not positive or a number is not finite.
    pub fn validate(self) -> Result<(), DataError> {
        let Self { fx, fy, cx, cy } = self;
        for (name, focal) in [("fx", fx), ("fy", fy)] {
            if !(focal.is_finite() && focal > 0.0) {
                return Err(DataError::BadCamera { what: format!("{name} is {focal}, expected a positive number") });
            }
        }
        for (name, centre) in [("cx", cx), ("cy", cy)] {
            if !centre.is_finite() {
                return Err(DataError::BadCamera { what: format!("{name} is {centre}, expected a finite number") });
            }
        }
        Ok(())
    }

    /// Divides `intrinsics` in pixels by the size of their image.
    pub fn of_pixels(intrinsics: Intrinsics, width: f64, height: f64) -> Self {
        let Intrinsics { fx, fy, cx, cy } = intrinsics;
        Self { fx: fx / width, fy: fy / height, cx: cx / width, cy: cy / height }
    }

    /// Scales to pixels of an image of `width` by `height`.
    pub fn to_pixels(self, width: usize, height: usize) -> Intrinsics {
        let (width, height) = (width as f64, height as f64);
        Intrinsics { fx: self.fx * width, fy: self.fy * height, cx: self.cx * width, cy: self.cy * height }
    }
}

/// A rigid motion: `x' = rotation * x + translation`. Whether it is `c2w` or `w2c` is in the name of its variable.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Row-major rotation matrix.
    pub rotation: [[f64; 3]; 3],
    /// Translation; for a `c2w` pose, the camera centre.
    pub translation: [f64; 3],
}

impl Pose {
    /// The motion that moves nothing.
    pub const IDENTITY: Self =
        Self { rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], translation: [0.0; 3] };

    /// Reads the upper three rows of a row-major 4 x 4 (or 3 x 4) matrix.
    ///
    /// # Errors
    /// [`DataError::BadCamera`] when a value is not finite or the rotation is not orthonormal to 1e-2
    /// with determinant +1 (published poses are orthonormal to about 4e-4).
    pub fn from_rows(rows: &[[f64; 4]; 3]) -> Result<Self, DataError> {
        if let Some(value) = rows.iter().flatten().find(|value| !value.is_finite()) {
            return Err(DataError::BadCamera { what: format!("the pose holds {value}") });
        }
        let pose = Self {
            rotation: [0, 1, 2].map(|r| [rows[r][0], rows[r][1], rows[r][2]]),
            translation: [0, 1, 2].map(|r| rows[r][3]),
        };
        let defect = pose.orthonormality_defect();
        if defect > 1e-2 {
            return Err(DataError::BadCamera {
                what: format!("the rotation is off an orthonormal one by {defect:.3e}, more than 1e-2"),
            });
        }
        let determinant = pose.determinant();
        if determinant < 0.0 {
            return Err(DataError::BadCamera { what: format!("the rotation mirrors (determinant {determinant:.3})") });
        }
        Ok(pose)
    }

    /// Reads a camera-to-world matrix in OpenGL/Blender axes (+x right, +y up, -z forward), as nerfstudio's
    /// `transforms.json` holds it, and turns the camera's axes to OpenCV's: `rows * diag(1, -1, -1, 1)`.
    /// World axes and camera centre stay as they are.
    ///
    /// # Errors
    /// As [`Pose::from_rows`].
    pub fn from_opengl(rows: &[[f64; 4]; 3]) -> Result<Self, DataError> {
        let mut pose = Self::from_rows(rows)?;
        for row in &mut pose.rotation {
            row[1] = -row[1];
            row[2] = -row[2];
        }
        Ok(pose)
    }

    /// Row-major 4 x 4 matrix in f32, as tensors hold it.
    pub fn to_matrix(self) -> [f32; 16] {
        self.to_matrix_f64().map(|value| value as f32)
    }

    /// Row-major 4 x 4 matrix.
    pub fn to_matrix_f64(self) -> [f64; 16] {
        let (r, t) = (self.rotation, self.translation);
        let mut matrix = [0.0; 16];
        for row in 0..3 {
            matrix[row * 4..row * 4 + 3].copy_from_slice(&r[row]);
            matrix[row * 4 + 3] = t[row];
        }
        matrix[15] = 1.0;
        matrix
    }

    /// Reads the upper three rows of [`Pose::to_matrix_f64`].
    ///
    /// # Errors
    /// As [`Pose::from_rows`].
    pub fn from_matrix(matrix: &[f64; 16]) -> Result<Self, DataError> {
        Self::from_rows(&[0, 1, 2].map(|row| [0, 1, 2, 3].map(|column| matrix[row * 4 + column])))
    }

    /// The opposite motion, exact for a rotation that is orthonormal: `[R^T | -R^T t]`.
    #[must_use]
    pub fn inverse(self) -> Self {
        let r = self.rotation;
        let transposed = [0, 1, 2].map(|i| [r[0][i], r[1][i], r[2][i]]);
        let rotated = multiply_vector(&transposed, self.translation);
        Self { rotation: transposed, translation: rotated.map(|value| -value) }
    }

    /// `self` after `first`: the motion `x -> self(first(x))`.
    #[must_use]
    pub fn after(self, first: Self) -> Self {
        Self { rotation: multiply(&self.rotation, &first.rotation), translation: self.apply(first.translation) }
    }

    /// Moves a point.
    pub fn apply(self, point: [f64; 3]) -> [f64; 3] {
        let rotated = self.rotate(point);
        [0, 1, 2].map(|i| rotated[i] + self.translation[i])
    }

    /// Turns a direction.
    pub fn rotate(self, direction: [f64; 3]) -> [f64; 3] {
        multiply_vector(&self.rotation, direction)
    }

    /// Largest absolute entry of `R^T R - I`.
    pub fn orthonormality_defect(self) -> f64 {
        let transposed = self.inverse().rotation;
        let product = multiply(&transposed, &self.rotation);
        let mut defect = 0.0_f64;
        for (i, row) in product.iter().enumerate() {
            for (j, value) in row.iter().enumerate() {
                defect = defect.max((value - f64::from(u8::from(i == j))).abs());
            }
        }
        defect
    }

    fn determinant(self) -> f64 {
        let [a, b, c] = self.rotation;
        dot(a, cross(b, c))
    }

    /// The opposite motion by matrix inversion. The readers of the chunk format invert `w2c` as a matrix, and a
    /// rotation rounded to f32 or to nine decimals has an inverse that differs from its transpose.
    fn matrix_inverse(self) -> Self {
        let [a, b, c] = self.rotation;
        let scale = 1.0 / self.determinant();
        let columns = [cross(b, c), cross(c, a), cross(a, b)];
        let rotation = [0, 1, 2].map(|i| columns.map(|column| column[i] * scale));
        Self { rotation, translation: multiply_vector(&rotation, self.translation).map(|value| -value) }
    }
}

/// One posed camera as a file gives it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Intrinsics over width and height.
    pub intrinsics_norm: IntrinsicsNorm,
    /// Camera to world.
    pub c2w: Pose,
}

impl Camera {
    /// Reads the 18 numbers that RealEstate10K and its chunks give per frame: `fx fy cx cy` over width and height,
    /// two placeholders (ignored), then `w2c` as 3 x 4, row-major, OpenCV axes. `c2w` is its matrix inverse.
    ///
    /// # Errors
    /// [`DataError::BadCamera`] when a focal length is not positive, a number is not finite or the pose is no
    /// rigid motion (see [`Pose::from_rows`]).
    pub fn from_re10k(row: [f64; 18]) -> Result<Self, DataError> {
        let [fx, fy, cx, cy, ..] = row;
        let intrinsics_norm = IntrinsicsNorm { fx, fy, cx, cy };
        intrinsics_norm.validate()?;
        let w2c = Pose::from_rows(&[0, 1, 2].map(|r| [0, 1, 2, 3].map(|c| row[6 + 4 * r + c])))?;
        Ok(Self { intrinsics_norm, c2w: w2c.matrix_inverse() })
    }

    /// Writes the 18 numbers that [`Camera::from_re10k`] reads, with zeros for the placeholders.
    pub fn to_re10k(&self) -> [f64; 18] {
        let IntrinsicsNorm { fx, fy, cx, cy } = self.intrinsics_norm;
        let w2c = self.c2w.matrix_inverse();
        let mut row = [0.0; 18];
        row[..4].copy_from_slice(&[fx, fy, cx, cy]);
        for r in 0..3 {
            row[6 + 4 * r..9 + 4 * r].copy_from_slice(&w2c.rotation[r]);
            row[9 + 4 * r] = w2c.translation[r];
        }
        row
    }

    /// Horizontal and vertical field of view in degrees: the angles between the rays through the middles of
    /// opposite image edges, as pixelSplat measures them for its 100 degree limit.
    pub fn fov_deg(&self) -> (f64, f64) {
        let IntrinsicsNorm { fx, fy, cx, cy } = self.intrinsics_norm;
        let ray = |u: f64, v: f64| [(u - cx) / fx, (v - cy) / fy, 1.0];
        (angle_deg(ray(0.0, 0.5), ray(1.0, 0.5)), angle_deg(ray(0.5, 0.0), ray(0.5, 1.0)))
    }
}

/// Angle between two directions in degrees; `atan2` stays exact where `acos` loses half the digits.
fn angle_deg(a: [f64; 3], b: [f64; 3]) -> f64 {
    let sine = cross(a, b);
    dot(sine, sine).sqrt().atan2(dot(a, b)).to_degrees()
}

/// Cross product.
pub(crate) fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Inner product.
pub(crate) fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Matrix product `a b`.
pub(crate) fn multiply(a: &[[f64; 3]; 3], b: &[[f64; 3]; 3]) -> [[f64; 3]; 3] {
    [0, 1, 2].map(|i| [0, 1, 2].map(|j| (0..3).map(|k| a[i][k] * b[k][j]).sum()))
}

/// Matrix times vector.
pub(crate) fn multiply_vector(a: &[[f64; 3]; 3], v: [f64; 3]) -> [f64; 3] {
    [0, 1, 2].map(|i| (0..3).map(|k| a[i][k] * v[k]).sum())
}

#[cfg(test)]
mod tests {
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
    fn a_re10k_row_becomes_the_camera_computed_by_hand() {
        let camera = Camera::from_re10k(LOOKS_ALONG_X).unwrap();
        assert_eq!(camera.intrinsics_norm, IntrinsicsNorm { fx: 0.9, fy: 1.6, cx: 0.5, cy: 0.25 });
        assert_eq!(camera.c2w.translation, [1.0, 2.0, 3.0]);
        assert_eq!(camera.c2w.rotate([0.0, 0.0, 1.0]), [1.0, 0.0, 0.0]);
        assert_eq!(camera.c2w.rotate([1.0, 0.0, 0.0]), [0.0, 0.0, -1.0]);
        assert_eq!(
            camera.intrinsics_norm.to_pixels(640, 360),
            Intrinsics { fx: 576.0, fy: 576.0, cx: 320.0, cy: 90.0 }
        );
    }

    #[test]
    fn a_re10k_row_survives_the_way_there_and_back() {
        // A rotation rounded to three decimals: its transpose is not its inverse.
        let mut row = LOOKS_ALONG_X;
        row[6..18].copy_from_slice(&[0.866, -0.5, 0.0, 10.0, 0.5, 0.866, 0.0, -20.0, 0.0, 0.0, 1.0, 30.0]);
        let back = Camera::from_re10k(row).unwrap().to_re10k();
        for (got, expected) in back.iter().zip(&row) {
            assert!((got - expected).abs() < 1e-13, "{got} against {expected}"); // a few roundings of 30
        }
    }

    #[test]
    fn opengl_identity_becomes_diag_1_minus_1_minus_1() {
        let rows = [[1.0, 0.0, 0.0, 4.0], [0.0, 1.0, 0.0, 5.0], [0.0, 0.0, 1.0, 6.0]];
        let c2w = Pose::from_opengl(&rows).unwrap();
        assert_eq!(c2w.rotation, [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]);
        assert_eq!(c2w.translation, [4.0, 5.0, 6.0]);
    }

    #[test]
    fn field_of_view_of_half_a_width_of_focal_length_is_90_degrees() {
        let mut row = LOOKS_ALONG_X;
        row[..4].copy_from_slice(&[0.5, 1.0, 0.5, 0.5]);
        let (x, y) = Camera::from_re10k(row).unwrap().fov_deg();
        assert!((x - 90.0).abs() < 1e-12, "{x}");
        assert!((y - 53.130_102_354_155_98).abs() < 1e-12, "{y}"); // 2 atan(1/2)
    }

    #[test]
    fn a_bad_row_says_which_number_is_bad() {
        let message = |index: usize, value: f64| {
            let mut row = LOOKS_ALONG_X;
            row[index] = value;
            Camera::from_re10k(row).unwrap_err().to_string()
        };
        assert_eq!(message(0, f64::NAN), "bad camera: fx is NaN, expected a positive number");
        assert_eq!(message(1, -0.5), "bad camera: fy is -0.5, expected a positive number");
        assert_eq!(message(3, f64::INFINITY), "bad camera: cy is inf, expected a finite number");
        assert_eq!(message(9, f64::NEG_INFINITY), "bad camera: the pose holds -inf");
        assert!(message(11, -1.0).contains("mirrors"), "{}", message(11, -1.0));
        assert!(message(11, 2.0).contains("off an orthonormal one by 3.000e0"), "{}", message(11, 2.0));
    }

    #[test]
    fn a_pose_after_its_inverse_moves_nothing() {
        let pose = Camera::from_re10k(LOOKS_ALONG_X).unwrap().c2w;
        assert_eq!(pose.after(pose.inverse()), Pose::IDENTITY);
        assert_eq!(pose.inverse().after(pose), Pose::IDENTITY);
    }
}
