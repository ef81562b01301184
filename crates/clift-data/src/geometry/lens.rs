//! Lens distortion in the models of OpenCV and COLMAP.

use clift_core::CameraError;
use glam::{DMat2, DVec2};

/// Largest number of Newton steps; real lenses need three to five.
const MAX_STEPS: usize = 50;
/// Points between the axis and a solution at which the Jacobian determinant must be positive.
const NUM_FOLD_CHECKS: usize = 16;

/// Radial (`k1 k2 k3`) and tangential (`p1 p2`) distortion of rays `(x, y, 1)`: OpenCV's five parameters.
///
/// COLMAP's models are subsets: `SIMPLE_RADIAL` has `k1`, `RADIAL` has `k1 k2`, `OPENCV` has `k1 k2 p1 p2`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Lens {
    /// Radial coefficients of r^2, r^4 and r^6.
    pub radial: [f64; 3],
    /// Tangential coefficients.
    pub tangential: [f64; 2],
}

impl Lens {
    /// Returns whether all coefficients are zero.
    pub fn is_pinhole(&self) -> bool {
        *self == Self::default()
    }

    /// Checks that every coefficient is finite.
    ///
    /// # Errors
    /// [`CameraError::BadCamera`] with the first coefficient that is not finite.
    pub fn validate(&self) -> Result<(), CameraError> {
        let [k1, k2, k3] = self.radial;
        let [p1, p2] = self.tangential;
        for (name, value) in [("k1", k1), ("k2", k2), ("k3", k3), ("p1", p1), ("p2", p2)] {
            if !value.is_finite() {
                return Err(CameraError::BadCamera { what: format!("{name} is {value}, expected a finite number") });
            }
        }
        Ok(())
    }

    /// Maps an undistorted ray `(x, y, 1)` to the distorted ray of the image.
    pub fn distort(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let [k1, k2, k3] = self.radial;
        let [p1, p2] = self.tangential;
        let r2 = x * x + y * y;
        let scale = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let mixed = 2.0 * x * y;
        [
            x * scale + p1 * mixed + p2 * (r2 + 2.0 * x * x), //
            y * scale + p1 * (r2 + 2.0 * y * y) + p2 * mixed,
        ]
    }

    /// Returns the derivatives of [`Lens::distort`], a symmetric matrix.
    fn jacobian(&self, DVec2 { x, y }: DVec2) -> DMat2 {
        let [k1, k2, k3] = self.radial;
        let [p1, p2] = self.tangential;
        let r2 = x * x + y * y;
        let scale = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3)); // of the scale, over x or y
        let mixed = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y;
        DMat2::from_cols_array_2d(&[
            [scale + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x, mixed],
            [mixed, scale + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x],
        ])
    }

    fn is_folded(&self, ray: DVec2) -> bool {
        let determinant = self.jacobian(ray).determinant();
        determinant.is_nan() || determinant <= 0.0
    }

    /// Inverts [`Lens::distort`] by Newton's method. Returns `None` beyond the radius at which the distortion folds
    /// over, and where the method does not converge to 1e-13.
    pub fn undistort(&self, point: [f64; 2]) -> Option<[f64; 2]> {
        let mut ray = DVec2::from(point);
        for _ in 0..MAX_STEPS {
            let error = DVec2::from(self.distort(ray.into())) - DVec2::from(point);
            if error.abs().max_element() < 1e-13 {
                let folds =
                    (1..=NUM_FOLD_CHECKS).any(|step| self.is_folded(ray * (step as f64 / NUM_FOLD_CHECKS as f64)));
                return (!folds).then_some(ray.into());
            }
            ray -= self.jacobian(ray).inverse() * error;
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const PHONE: Lens = Lens { radial: [0.058, -0.081, 0.0], tangential: [-0.000_98, 0.000_16] };

    #[test]
    fn jacobian_equals_finite_differences() {
        let (point, step) = ([0.31, -0.47], 1e-6);
        let lens = Lens { radial: [-0.3, 0.12, -0.02], ..PHONE };
        let jacobian = lens.jacobian(point.into()).to_cols_array_2d();
        for axis in 0..2 {
            let moved = |sign: f64| {
                let mut point = point;
                point[axis] += sign * step;
                lens.distort(point)
            };
            let (ahead, behind) = (moved(1.0), moved(-1.0));
            for row in 0..2 {
                let slope = (ahead[row] - behind[row]) / (2.0 * step);
                assert!((jacobian[row][axis] - slope).abs() < 1e-9, "{jacobian:?}, {slope}"); // the square of the step
            }
        }
    }

    #[test]
    fn undistort_returns_none_beyond_the_fold() {
        let lens = Lens { radial: [-0.5, 0.0, 0.0], ..Lens::default() };
        // x (1 - x^2 / 2) is largest at sqrt(2/3): 0.544.
        assert!(lens.undistort([0.54, 0.0]).is_some());
        assert_eq!(lens.undistort([0.55, 0.0]), None);
        let wild = Lens { radial: [1e300, -1e300, f64::MAX], tangential: [1e200, 0.0] };
        assert_eq!(wild.undistort([0.5, 0.5]), None);
    }

    #[test]
    fn non_finite_coefficient_is_named() {
        let lens = Lens { tangential: [0.0, f64::NAN], ..PHONE };
        assert_eq!(lens.validate().unwrap_err().to_string(), "bad camera: p2 is NaN, expected a finite number");
        assert!(PHONE.validate().is_ok() && !PHONE.is_pinhole() && Lens::default().is_pinhole());
    }

    proptest! {
        #[test]
        fn undistort_inverts_distort(
            x in -0.8..0.8, y in -0.8..0.8, k1 in -0.2..0.2, k2 in -0.05..0.05, p in -0.01..0.01,
        ) {
            let lens = Lens { radial: [k1, k2, 0.0], tangential: [p, -p / 2.0] };
            let ray = lens.undistort(lens.distort([x, y]));
            // Within this radius and these coefficients no lens folds over.
            let [u, v] = ray.expect("a ray");
            prop_assert!((u - x).abs() < 1e-9 && (v - y).abs() < 1e-9, "{u} {v}");
        }
    }
}
