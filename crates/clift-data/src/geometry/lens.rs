//! Lens distortion in the models of OpenCV, nerfstudio and COLMAP, and COLMAP's camera models by name.

use std::f64::consts::FRAC_PI_2;

use clift_core::CameraError;
use glam::{DMat2, DVec2};

/// Largest number of Newton steps; real lenses need three to five.
const MAX_STEPS: usize = 50;
/// Points between the axis and a solution at which the Jacobian determinant must be positive.
const NUM_FOLD_CHECKS: usize = 16;

/// Returns `atan(r) / r` at `r2 = r^2`.
fn arctangent_factor(r2: f64) -> f64 {
    if r2 < 1e-6 { 1.0 - r2 / 3.0 + r2 * r2 / 5.0 } else { r2.sqrt().atan() / r2.sqrt() }
}

/// Returns `1 + c0 t + c1 t^2 + ..` and its derivative.
fn polynomial(coefficients: &[f64], t: f64) -> (f64, f64) {
    let highest_first = coefficients.iter().rev();
    let (value, slope) = highest_first.fold((0.0, 0.0), |(value, slope), c| (value * t + c, slope * t + value));
    (1.0 + value * t, value + slope * t)
}

/// Distortion of rays `(x, y, 1)`. The default is the pinhole camera.
///
/// With `q` the projection of the ray and `r = |q|`, the distorted ray is `q (1 + radial) / (1 + divisor)` plus the
/// tangential and prism terms.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Lens {
    /// Whether the distance of the projection from the principal point is the ray's angle to the axis in radians
    /// (equidistant: the fisheye models of OpenCV and COLMAP), not the tangent of that angle.
    pub is_fisheye: bool,
    /// Radial coefficients of `r^2`, `r^4`, `r^6` and `r^8`.
    pub radial: [f64; 4],
    /// Coefficients of `r^2`, `r^4` and `r^6` of the divisor: `k4 k5 k6` of OpenCV's rational model.
    pub divisor: [f64; 3],
    /// Tangential coefficients `p1 p2`.
    pub tangential: [f64; 2],
    /// Thin prism coefficients of `r^2`, of x and of y.
    pub prism: [f64; 2],
}

impl Lens {
    /// Returns whether rays are not distorted.
    pub fn is_pinhole(&self) -> bool {
        *self == Self::default()
    }

    /// Checks that every coefficient is finite.
    ///
    /// # Errors
    /// [`CameraError::BadCamera`] with the first bad coefficient.
    pub fn validate(&self) -> Result<(), CameraError> {
        let names = ["k1", "k2", "k3", "k4", "k4", "k5", "k6", "p1", "p2", "sx", "sy"];
        let values = [&self.radial[..], &self.divisor, &self.tangential, &self.prism].concat();
        match names.iter().zip(values).find(|(_, value)| !value.is_finite()) {
            Some((name, value)) => {
                Err(CameraError::BadCamera { what: format!("{name} is {value}, expected a finite number") })
            }
            None => Ok(()),
        }
    }

    /// Maps an undistorted ray `(x, y, 1)` to the distorted ray of the image.
    #[inline]
    pub fn distort(&self, ray: [f64; 2]) -> [f64; 2] {
        self.distort_projected(self.project(ray.into())).into()
    }

    fn project(&self, ray: DVec2) -> DVec2 {
        if self.is_fisheye { ray * arctangent_factor(ray.length_squared()) } else { ray }
    }

    /// Inverts the projection; `None` for rays at 90 degrees and more.
    fn ray(&self, projected: DVec2) -> Option<DVec2> {
        let angle = projected.length();
        if !self.is_fisheye || angle == 0.0 {
            return Some(projected);
        }
        (angle < FRAC_PI_2).then(|| projected * (angle.tan() / angle))
    }

    /// Computes [`Lens::distort`] of a lens that [`Lens::is_opencv`].
    #[inline]
    pub(crate) fn distort_opencv(&self, ray: [f64; 2]) -> [f64; 2] {
        let ([k1, k2, k3, ..], ray) = (self.radial, DVec2::from(ray));
        let r2 = ray.length_squared();
        (ray * (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) + self.tangential(ray)).into()
    }

    /// Returns whether there are none but OpenCV's five coefficients.
    pub(crate) fn is_opencv(&self) -> bool {
        let [k1, k2, k3, ..] = self.radial;
        *self == Self { radial: [k1, k2, k3, 0.0], tangential: self.tangential, ..Self::default() }
    }

    /// Returns the radial factor at the square of a distance, and its derivative over that square.
    fn radial_factor(&self, r2: f64) -> (f64, f64) {
        let (above, slope_above) = polynomial(&self.radial, r2);
        let (below, slope_below) = polynomial(&self.divisor, r2);
        let factor = above / below;
        (factor, (slope_above - factor * slope_below) / below)
    }

    fn shift(&self, at: DVec2) -> DVec2 {
        self.tangential(at) + DVec2::from(self.prism) * at.length_squared()
    }

    fn tangential(&self, at: DVec2) -> DVec2 {
        let (DVec2 { x, y }, [p1, p2]) = (at, self.tangential);
        let (r2, mixed) = (at.length_squared(), 2.0 * x * y);
        DVec2::new(p1 * mixed + p2 * (r2 + 2.0 * x * x), p1 * (r2 + 2.0 * y * y) + p2 * mixed)
    }

    fn distort_projected(&self, projected: DVec2) -> DVec2 {
        projected * self.radial_factor(projected.length_squared()).0 + self.shift(projected)
    }

    fn jacobian(&self, projected: DVec2) -> DMat2 {
        let (factor, slope) = self.radial_factor(projected.length_squared());
        let columns = |axis: DVec2, at: f64| axis * factor + projected * (2.0 * slope * at);
        let radial = DMat2::from_cols(columns(DVec2::X, projected.x), columns(DVec2::Y, projected.y));
        let (DVec2 { x, y }, [p1, p2], [sx, sy]) = (projected, self.tangential, self.prism);
        let mixed = 2.0 * (p1 * x + p2 * y);
        let shift = DMat2::from_cols_array_2d(&[
            [2.0 * p1 * y + 6.0 * p2 * x + 2.0 * sx * x, mixed + 2.0 * sy * x],
            [mixed + 2.0 * sx * y, 6.0 * p1 * y + 2.0 * p2 * x + 2.0 * sy * y],
        ]);
        radial + shift
    }

    /// Returns whether the distortion folds over between the axis and a projection.
    fn folds(&self, projected: DVec2) -> bool {
        (1..=NUM_FOLD_CHECKS).any(|step| {
            let determinant = self.jacobian(projected * (step as f64 / NUM_FOLD_CHECKS as f64)).determinant();
            determinant.is_nan() || determinant <= 0.0
        })
    }

    /// Returns whether [`Lens::undistort`] inverts [`Lens::distort`] at a ray: the distortion does not fold over before.
    pub(crate) fn is_invertible_at(&self, ray: [f64; 2]) -> bool {
        let projected = self.project(ray.into());
        projected.is_finite() && !self.folds(projected)
    }

    /// Inverts [`Lens::distort`] by Newton's method. Returns `None` for rays at 90 degrees to the axis and more, beyond
    /// the radius at which the distortion folds over, and where the method does not converge to 1e-13.
    pub fn undistort(&self, point: [f64; 2]) -> Option<[f64; 2]> {
        let mut projected = DVec2::from(point);
        for _ in 0..MAX_STEPS {
            let error = self.distort_projected(projected) - DVec2::from(point);
            if error.abs().max_element() < 1e-13 {
                let ray = self.ray(projected).filter(|_| !self.folds(projected));
                return ray.map(Into::into);
            }
            projected -= self.jacobian(projected).inverse() * error;
        }
        None
    }
}

/// Names of COLMAP's camera models by model id, with their numbers of focal lengths and of distortion parameters. The
/// principal point lies between these two. Models that cannot be used have no focal length here.
pub(crate) const MODELS: [(&str, usize, usize); 18] = [
    ("SIMPLE_PINHOLE", 1, 0),
    ("PINHOLE", 2, 0),
    ("SIMPLE_RADIAL", 1, 1),
    ("RADIAL", 1, 2),
    ("OPENCV", 2, 4),
    ("OPENCV_FISHEYE", 2, 4),
    ("FULL_OPENCV", 2, 8),
    ("FOV", 0, 3),
    ("SIMPLE_RADIAL_FISHEYE", 1, 1),
    ("RADIAL_FISHEYE", 1, 2),
    ("THIN_PRISM_FISHEYE", 2, 8),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 0, 14),
    ("SIMPLE_DIVISION", 0, 2),
    ("DIVISION", 0, 3),
    ("SIMPLE_FISHEYE", 1, 0),
    ("FISHEYE", 2, 0),
    ("EUCM", 0, 4),
    ("EQUIRECTANGULAR", 0, 0),
];

impl Lens {
    /// Returns the lens of a COLMAP model, its name in any case; `distortion` are the parameters that follow the
    /// principal point. `None` for a model that cannot be used, and for another number of parameters.
    pub fn from_colmap(model: &str, distortion: &[f64]) -> Option<Self> {
        let pinhole = Self::default();
        let fisheye = Self { is_fisheye: true, ..pinhole };
        Some(match (model.to_ascii_uppercase().as_str(), distortion) {
            ("SIMPLE_PINHOLE" | "PINHOLE", &[]) => pinhole,
            ("SIMPLE_RADIAL", &[k]) => Self { radial: [k, 0.0, 0.0, 0.0], ..pinhole },
            ("RADIAL", &[k1, k2]) => Self { radial: [k1, k2, 0.0, 0.0], ..pinhole },
            ("OPENCV", &[k1, k2, p1, p2]) => Self { radial: [k1, k2, 0.0, 0.0], tangential: [p1, p2], ..pinhole },
            ("FULL_OPENCV", &[k1, k2, p1, p2, k3, k4, k5, k6]) => {
                Self { radial: [k1, k2, k3, 0.0], divisor: [k4, k5, k6], tangential: [p1, p2], ..pinhole }
            }
            ("SIMPLE_FISHEYE" | "FISHEYE", &[]) => fisheye,
            ("SIMPLE_RADIAL_FISHEYE", &[k]) => Self { radial: [k, 0.0, 0.0, 0.0], ..fisheye },
            ("RADIAL_FISHEYE", &[k1, k2]) => Self { radial: [k1, k2, 0.0, 0.0], ..fisheye },
            ("OPENCV_FISHEYE", &[k1, k2, k3, k4]) => Self { radial: [k1, k2, k3, k4], ..fisheye },
            ("THIN_PRISM_FISHEYE", &[k1, k2, p1, p2, k3, k4, sx, sy]) => {
                Self { radial: [k1, k2, k3, k4], tangential: [p1, p2], prism: [sx, sy], ..fisheye }
            }
            _ => return None,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PHONE: Lens = Lens {
        is_fisheye: false,
        radial: [0.058, -0.081, 0.0, 0.0],
        divisor: [0.0; 3],
        tangential: [-0.000_98, 0.000_16],
        prism: [0.0; 2],
    };

    #[test]
    fn derivatives_equal_finite_differences() {
        let step = 1e-6;
        let lens =
            Lens { radial: [-0.3, 0.12, -0.02, 0.01], divisor: [0.1, -0.03, 0.02], prism: [0.01, 0.03], ..PHONE };
        let point = DVec2::new(0.31, -0.47);
        let jacobian = lens.jacobian(point);
        for (axis, column) in [(DVec2::X, jacobian.x_axis), (DVec2::Y, jacobian.y_axis)] {
            let [ahead, behind] = [axis, -axis].map(|way| lens.distort_projected(point + way * step));
            let slope = (ahead - behind) / (2.0 * step);
            assert!(slope.distance(column) < 1e-9, "{jacobian:?}, {slope}"); // the square of the step
        }
    }

    #[test]
    fn undistort_returns_none_beyond_the_fold() {
        let lens = Lens { radial: [-0.5, 0.0, 0.0, 0.0], ..Lens::default() };
        // x (1 - x^2 / 2) is largest at sqrt(2/3): 0.544.
        assert!(lens.undistort([0.54, 0.0]).is_some());
        assert_eq!(lens.undistort([0.55, 0.0]), None);
        assert!(lens.is_invertible_at([0.81, 0.0]) && !lens.is_invertible_at([0.82, 0.0]));
        let wild = Lens { radial: [1e300, -1e300, f64::MAX, 0.0], tangential: [1e200, 0.0], ..lens };
        assert_eq!(wild.undistort([0.5, 0.5]), None);
    }

    #[test]
    fn bad_coefficients_are_named_and_opencv_lenses_take_the_short_formula() {
        let message = |lens: Lens| lens.validate().unwrap_err().to_string();
        let bad_p2 = Lens { tangential: [0.0, f64::NAN], ..PHONE };
        assert_eq!(message(bad_p2), "bad camera: p2 is NaN, expected a finite number");
        assert!(PHONE.is_opencv() && !Lens { divisor: [0.1, 0.0, 0.0], ..PHONE }.is_opencv());
        let ([x, y], [fast_x, fast_y]) = (PHONE.distort([0.3, -0.2]), PHONE.distort_opencv([0.3, -0.2]));
        assert!((x - fast_x).abs() < 1e-15 && (y - fast_y).abs() < 1e-15);
        assert!(PHONE.validate().is_ok() && !PHONE.is_pinhole() && Lens::default().is_pinhole());
    }
}
