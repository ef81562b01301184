//! Rigid poses in f64.
//!
//! Camera axes are OpenCV's: +x right, +y down, +z forward. The name of a variable gives the direction of the pose:
//! `c2w` (camera to world) or `w2c` (world to camera).

use glam::{DMat3, DMat4, DQuat, DVec3, DVec4};

use crate::error::CameraError;

/// Largest entry of `R^T R - I` of an accepted rotation; published poses reach about 4e-4.
const MAX_DEFECT: f64 = 1e-2;

/// A rigid motion `x' = rotation * x + translation`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Rotation matrix.
    pub rotation: DMat3,
    /// Translation in world units. For a `c2w` pose this is the camera centre.
    pub translation: DVec3,
}

impl Pose {
    /// The identity.
    pub const IDENTITY: Self = Self { rotation: DMat3::IDENTITY, translation: DVec3::ZERO };

    /// Returns the rotation angle between two poses in radians, from its sine and cosine, which is exact for small angles too.
    pub fn angle_to(self, other: Self) -> f64 {
        let r = self.rotation.transpose() * other.rotation;
        let axis = DVec3::new(r.y_axis.z - r.z_axis.y, r.z_axis.x - r.x_axis.z, r.x_axis.y - r.y_axis.x);
        axis.length().atan2(r.diagonal().element_sum() - 1.0)
    }

    /// Converts the upper three rows of a 4 x 4 matrix.
    pub fn from_rows(rows: &[[f64; 4]; 3]) -> Result<Self, CameraError> {
        let [x, y, z] = rows.map(|[a, b, c, _]| DVec3::new(a, b, c));
        let pose = Self { rotation: DMat3::from_rows(x, y, z), translation: rows.map(|row| row[3]).into() };
        pose.validate()?;
        Ok(pose)
    }

    /// Checks that all numbers are finite and that the rotation is orthonormal up to 1e-2 and does not mirror.
    pub fn validate(self) -> Result<(), CameraError> {
        self.check_finite()?;
        let defect = self.orthonormality_defect();
        let determinant = self.rotation.determinant();
        let what = if defect > MAX_DEFECT {
            format!("the rotation is off an orthonormal one by {defect:.3e}, more than {MAX_DEFECT:.0e}")
        } else if determinant < 0.0 {
            format!("the rotation mirrors (determinant {determinant:.3})")
        } else {
            return Ok(());
        };
        Err(CameraError::BadCamera { what })
    }

    /// Converts the upper three rows of a camera-to-world matrix with OpenGL camera axes (+x right, +y up, -z forward),
    /// as in nerfstudio's `transforms.json`: `rows * diag(1, -1, -1, 1)`. World axes and camera centre do not change.
    pub fn from_opengl(rows: &[[f64; 4]; 3]) -> Result<Self, CameraError> {
        let Self { rotation, translation } = Self::from_rows(rows)?;
        Ok(Self { rotation: DMat3::from_cols(rotation.x_axis, -rotation.y_axis, -rotation.z_axis), translation })
    }

    /// Returns the row-major 4 x 4 matrix.
    pub fn to_matrix_f64(self) -> [f64; 16] {
        DMat4::from_mat3_translation(self.rotation, self.translation).to_rows_array()
    }

    /// Converts a row-major 4 x 4 matrix.
    pub fn from_matrix(matrix: &[f64; 16]) -> Result<Self, CameraError> {
        let [x, y, z, last] = [0, 4, 8, 12].map(|start| [0, 1, 2, 3].map(|column| matrix[start + column]));
        if last != [0.0, 0.0, 0.0, 1.0] {
            let what = format!("the last row of the pose is {last:?}, expected [0, 0, 0, 1]");
            return Err(CameraError::BadCamera { what });
        }
        Self::from_rows(&[x, y, z])
    }

    /// Returns the inverse motion `[R^T | -R^T t]` of an orthonormal rotation.
    #[must_use]
    pub fn inverse(self) -> Self {
        let rotation = self.rotation.transpose();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// Returns the inverse of the matrix. Readers of the chunk format invert `w2c` as a matrix, and the inverse of a
    /// rotation rounded to f32 or to nine decimals differs from its transpose.
    #[must_use]
    pub fn matrix_inverse(self) -> Self {
        // With the two transposes glam rounds as the writers of existing files did.
        let rotation = self.rotation.transpose().inverse().transpose();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// Returns the composed motion `x -> self(first(x))`.
    #[must_use]
    pub fn after(self, first: Self) -> Self {
        Self { rotation: self.rotation * first.rotation, translation: self.apply(first.translation) }
    }

    /// Moves a point.
    pub fn apply(self, point: DVec3) -> DVec3 {
        self.rotation * point + self.translation
    }

    /// Returns the largest absolute entry of `R^T R - I`.
    pub fn orthonormality_defect(self) -> f64 {
        let difference = self.rotation.transpose() * self.rotation - DMat3::IDENTITY;
        difference.to_cols_array().into_iter().fold(0.0, |largest: f64, value| largest.max(value.abs()))
    }

    /// Checks that all numbers are finite.
    pub fn check_finite(self) -> Result<(), CameraError> {
        let mut values = self.rotation.to_rows_array().into_iter().chain(self.translation.to_array());
        match values.find(|value| !value.is_finite()) {
            Some(value) => Err(CameraError::BadCamera { what: format!("the pose holds {value}") }),
            None => Ok(()),
        }
    }

    /// Returns the unit quaternion of the rotation, computed from the largest of the four squared components.
    ///
    // Not `DQuat::from_mat3`: for a rotation rounded to four digits it departs from scipy's `Rotation.from_matrix`,
    // which normalises published poses, by more than rounding.
    pub fn quaternion(self) -> DQuat {
        let [[xx, yx, zx], [xy, yy, zy], [xz, yz, zz]] = self.rotation.to_cols_array_2d();
        let squares = [1.0 + xx + yy + zz, 1.0 + xx - yy - zz, 1.0 - xx + yy - zz, 1.0 - xx - yy + zz];
        let [wx, wy, wz] = [zy - yz, xz - zx, yx - xy];
        let [xy, xz, yz] = [xy + yx, xz + zx, yz + zy];
        let largest = (0..4).fold(0, |best, i| if squares[i] > squares[best] { i } else { best });
        // Four times the products of the largest component with x, y, z and w.
        let [x, y, z, w] = match largest {
            0 => [wx, wy, wz, squares[0]],
            1 => [squares[1], xy, xz, wx],
            2 => [xy, squares[2], yz, wy],
            _ => [xz, yz, squares[3], wz],
        };
        unit_quaternion(DQuat::from_xyzw(x, y, z, w))
    }
}

/// Normalises with the rounding of existing files: glam's `normalize` sums `w` last and multiplies by a reciprocal.
pub(crate) fn unit_quaternion(q: DQuat) -> DQuat {
    q / DVec4::new(q.w, q.x, q.y, q.z).length()
}
