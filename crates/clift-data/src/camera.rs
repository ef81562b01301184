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

    /// Row-major 4 x 4 matrix in f32, as tensors hold it.
    pub fn to_matrix(self) -> [f32; 16] {
        let (r, t) = (self.rotation, self.translation);
        let mut matrix = [0.0; 16];
        for row in 0..3 {
            for column in 0..3 {
                matrix[row * 4 + column] = r[row][column] as f32;
            }
            matrix[row * 4 + 3] = t[row] as f32;
        }
        matrix[15] = 1.0;
        matrix
    }

    /// The opposite motion, exact for a rotation that is orthonormal: `[R^T | -R^T t]`.
    pub fn inverse(self) -> Self {
        let r = self.rotation;
        let transposed = [0, 1, 2].map(|i| [r[0][i], r[1][i], r[2][i]]);
        let rotated = multiply_vector(&transposed, self.translation);
        Self { rotation: transposed, translation: rotated.map(|value| -value) }
    }

    /// `self` after `first`: the motion `x -> self(first(x))`.
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
        a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0])
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

/// Matrix product `a b`.
pub(crate) fn multiply(a: &[[f64; 3]; 3], b: &[[f64; 3]; 3]) -> [[f64; 3]; 3] {
    [0, 1, 2].map(|i| [0, 1, 2].map(|j| (0..3).map(|k| a[i][k] * b[k][j]).sum()))
}

/// Matrix times vector.
pub(crate) fn multiply_vector(a: &[[f64; 3]; 3], v: [f64; 3]) -> [f64; 3] {
    [0, 1, 2].map(|i| (0..3).map(|k| a[i][k] * v[k]).sum())
}
