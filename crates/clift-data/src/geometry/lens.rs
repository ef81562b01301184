//! Lens distortion in the models of OpenCV, nerfstudio and COLMAP.

use std::f64::consts::{FRAC_PI_2, PI};

use clift_core::CameraError;
use glam::{DMat2, DVec2};

/// Largest number of Newton steps; real lenses need three to five.
const MAX_STEPS: usize = 50;
/// Points between the axis and a solution at which the Jacobian determinant must be positive.
const NUM_FOLD_CHECKS: usize = 16;

/// How the tangent of a ray's angle to the axis becomes a distance from the principal point, before the polynomials.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Projection {
    /// The tangent itself: pinhole cameras and OpenCV's lenses.
    #[default]
    Perspective,
    /// The angle in radians (equidistant): the fisheye models of OpenCV and COLMAP.
    Fisheye,
    /// COLMAP's `FOV`, with `omega` in radians.
    Fov(f64),
    /// COLMAP's `DIVISION`, with `k`.
    Division(f64),
    /// COLMAP's `EUCM`, the extended unified camera model, with `alpha` and `beta`.
    Eucm(f64, f64),
}

impl Projection {
    /// Returns the factor from a ray `(x, y, 1)` to its projection at `r2 = x^2 + y^2`, and the derivative of that
    /// factor over `r2`.
    fn factor(self, r2: f64) -> (f64, f64) {
        match self {
            Self::Perspective => (1.0, 0.0),
            Self::Fisheye => arctangent_factor(r2),
            Self::Fov(omega) => {
                let width = 2.0 * (omega / 2.0).tan();
                let (factor, slope) = arctangent_factor(width * width * r2);
                (width / omega * factor, width.powi(3) / omega * slope)
            }
            Self::Division(k) => {
                let root = (1.0 - 4.0 * k * r2).sqrt();
                (2.0 / (1.0 + root), 4.0 * k / (root * (1.0 + root).powi(2)))
            }
            Self::Eucm(alpha, beta) => {
                let root = (beta * r2 + 1.0).sqrt();
                let factor = 1.0 / (alpha * root + 1.0 - alpha);
                (factor, -0.5 * alpha * beta / root * factor * factor)
            }
        }
    }

    /// Inverts the projection; `None` for rays at 90 degrees and more.
    fn ray(self, projected: DVec2) -> Option<DVec2> {
        let (distance, square) = (projected.length(), projected.length_squared());
        let tangent_factor =
            |angle: f64| (angle < FRAC_PI_2).then(|| if angle == 0.0 { 1.0 } else { angle.tan() / angle });
        let factor = match self {
            Self::Perspective => Some(1.0),
            Self::Fisheye => tangent_factor(distance),
            Self::Fov(omega) => {
                tangent_factor(omega.abs() * distance).map(|factor| factor * omega / (2.0 * (omega / 2.0).tan()))
            }
            Self::Division(k) => (k.abs() * square < 1.0).then(|| 1.0 / (1.0 + k * square)),
            Self::Eucm(alpha, beta) => {
                let root = alpha * (1.0 - (2.0 * alpha - 1.0) * beta * square).sqrt();
                Some((root + 1.0 - alpha) / (1.0 - beta * alpha * alpha * square)).filter(|factor| *factor > 0.0)
            }
        };
        factor.map(|factor| projected * factor)
    }
}

/// Returns `atan(r) / r` at `r2 = r^2`, and its derivative over `r2`.
fn arctangent_factor(r2: f64) -> (f64, f64) {
    if r2 < 1e-6 {
        return (1.0 - r2 / 3.0 + r2 * r2 / 5.0, -1.0 / 3.0 + r2 * 0.4 - r2 * r2 * 3.0 / 7.0);
    }
    let factor = r2.sqrt().atan() / r2.sqrt();
    (factor, (1.0 / (1.0 + r2) - factor) / (2.0 * r2))
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
/// tangential and prism terms: every camera model of OpenCV, nerfstudio and COLMAP (panoramas excepted) is a case of it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Lens {
    /// Projection before the polynomials.
    pub projection: Projection,
    /// Radial coefficients of `r^2`, `r^4` .. `r^12`.
    pub radial: [f64; 6],
    /// Coefficients of `r^2`, `r^4` and `r^6` of the divisor: `k4 k5 k6` of OpenCV's rational model.
    pub divisor: [f64; 3],
    /// Tangential coefficients `p1 p2`.
    pub tangential: [f64; 2],
    /// Thin prism coefficients of `r^2` and `r^4`, first those of x, then those of y.
    pub prism: [f64; 4],
    /// Whether tangential and prism terms are computed from the radially distorted point, as Project Aria does.
    pub radial_first: bool,
}

impl Lens {
    /// Returns whether rays are not distorted.
    pub fn is_pinhole(&self) -> bool {
        *self == Self { radial_first: self.radial_first, ..Self::default() }
    }

    /// Checks that every coefficient is finite, and that of a `FOV` lens within half a turn.
    ///
    /// # Errors
    /// [`CameraError::BadCamera`] with the first bad coefficient.
    pub fn validate(&self) -> Result<(), CameraError> {
        let bad = |what: String| Err(CameraError::BadCamera { what });
        let projection = match self.projection {
            Projection::Perspective | Projection::Fisheye => vec![],
            Projection::Fov(omega) => vec![("omega", omega)],
            Projection::Division(k) => vec![("k", k)],
            Projection::Eucm(alpha, beta) => vec![("alpha", alpha), ("beta", beta)],
        };
        let radial = ["k1", "k2", "k3", "k4", "k5", "k6"].into_iter().zip(self.radial);
        let divisor = ["k4", "k5", "k6"].into_iter().zip(self.divisor);
        let tangential = ["p1", "p2"].into_iter().zip(self.tangential);
        let prism = ["s1", "s2", "s3", "s4"].into_iter().zip(self.prism);
        for (name, value) in projection.into_iter().chain(radial).chain(divisor).chain(tangential).chain(prism) {
            if !value.is_finite() {
                return bad(format!("{name} is {value}, expected a finite number"));
            }
        }
        match self.projection {
            Projection::Fov(omega) if omega == 0.0 || omega.abs() >= PI => {
                bad(format!("omega is {omega}, expected an angle between 0 and pi"))
            }
            _ => Ok(()),
        }
    }

    /// Maps an undistorted ray `(x, y, 1)` to the distorted ray of the image.
    #[inline]
    pub fn distort(&self, ray: [f64; 2]) -> [f64; 2] {
        let ray = DVec2::from(ray);
        self.distort_projected(ray * self.projection.factor(ray.length_squared()).0).into()
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
        *self == Self { radial: [k1, k2, k3, 0.0, 0.0, 0.0], tangential: self.tangential, ..Self::default() }
    }

    /// Returns the radial factor at the square of a distance, and its derivative over that square.
    fn radial_factor(&self, r2: f64) -> (f64, f64) {
        let (above, slope_above) = polynomial(&self.radial, r2);
        let (below, slope_below) = polynomial(&self.divisor, r2);
        let factor = above / below;
        (factor, (slope_above - factor * slope_below) / below)
    }

    /// Returns the tangential and prism terms.
    fn shift(&self, at: DVec2) -> DVec2 {
        let ([s1, s2, s3, s4], r2) = (self.prism, at.length_squared());
        self.tangential(at) + DVec2::new(r2 * (s1 + r2 * s2), r2 * (s3 + r2 * s4))
    }

    fn tangential(&self, at: DVec2) -> DVec2 {
        let (DVec2 { x, y }, [p1, p2]) = (at, self.tangential);
        let (r2, mixed) = (at.length_squared(), 2.0 * x * y);
        DVec2::new(p1 * mixed + p2 * (r2 + 2.0 * x * x), p1 * (r2 + 2.0 * y * y) + p2 * mixed)
    }

    /// Returns the distorted ray of a projection.
    fn distort_projected(&self, projected: DVec2) -> DVec2 {
        let radial = projected * self.radial_factor(projected.length_squared()).0;
        radial + self.shift(if self.radial_first { radial } else { projected })
    }

    /// Returns the derivatives of [`Lens::distort_projected`].
    fn jacobian(&self, projected: DVec2) -> DMat2 {
        let (factor, slope) = self.radial_factor(projected.length_squared());
        let columns = |axis: DVec2, at: f64| axis * factor + projected * (2.0 * slope * at);
        let radial = DMat2::from_cols(columns(DVec2::X, projected.x), columns(DVec2::Y, projected.y));
        let at = if self.radial_first { projected * factor } else { projected };
        let (DVec2 { x, y }, r2) = (at, at.length_squared());
        let ([p1, p2], [s1, s2, s3, s4]) = (self.tangential, self.prism);
        let (slope_x, slope_y) = (2.0 * (s1 + 2.0 * r2 * s2), 2.0 * (s3 + 2.0 * r2 * s4));
        let mixed = 2.0 * (p1 * x + p2 * y);
        let shift = DMat2::from_cols_array_2d(&[
            [2.0 * p1 * y + 6.0 * p2 * x + slope_x * x, mixed + slope_y * x],
            [mixed + slope_x * y, 6.0 * p1 * y + 2.0 * p2 * x + slope_y * y],
        ]);
        radial + if self.radial_first { shift * radial } else { shift }
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
        let ray = DVec2::from(ray);
        let projected = ray * self.projection.factor(ray.length_squared()).0;
        projected.is_finite() && !self.folds(projected)
    }

    /// Inverts [`Lens::distort`] by Newton's method. Returns `None` for rays at 90 degrees to the axis and more, beyond
    /// the radius at which the distortion folds over, and where the method does not converge to 1e-13.
    pub fn undistort(&self, point: [f64; 2]) -> Option<[f64; 2]> {
        let mut projected = DVec2::from(point);
        for _ in 0..MAX_STEPS {
            let error = self.distort_projected(projected) - DVec2::from(point);
            if error.abs().max_element() < 1e-13 {
                let ray = self.projection.ray(projected).filter(|_| !self.folds(projected));
                return ray.map(Into::into);
            }
            projected -= self.jacobian(projected).inverse() * error;
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const PHONE: Lens = Lens {
        projection: Projection::Perspective,
        radial: [0.058, -0.081, 0.0, 0.0, 0.0, 0.0],
        divisor: [0.0; 3],
        tangential: [-0.000_98, 0.000_16],
        prism: [0.0; 4],
        radial_first: false,
    };

    #[test]
    fn derivatives_equal_finite_differences() {
        let step = 1e-6;
        let full = Lens {
            radial: [-0.3, 0.12, -0.02, 0.01, -0.004, 0.002],
            divisor: [0.1, -0.03, 0.02],
            prism: [0.01, -0.02, 0.03, 0.004],
            ..PHONE
        };
        for lens in [full, Lens { radial_first: true, ..full }] {
            let point = DVec2::new(0.31, -0.47);
            let jacobian = lens.jacobian(point);
            for (axis, column) in [(DVec2::X, jacobian.x_axis), (DVec2::Y, jacobian.y_axis)] {
                let (ahead, behind) =
                    (lens.distort_projected(point + axis * step), lens.distort_projected(point - axis * step));
                let slope = (ahead - behind) / (2.0 * step);
                assert!(slope.distance(column) < 1e-9, "{jacobian:?}, {slope}"); // the square of the step
            }
        }
    }

    #[test]
    fn projections_invert_and_their_slopes_equal_finite_differences() {
        for projection in [
            Projection::Perspective,
            Projection::Fisheye,
            Projection::Fov(0.9),
            Projection::Division(-0.2),
            Projection::Division(0.05),
            Projection::Eucm(0.6, 1.1),
        ] {
            for point in [DVec2::ZERO, DVec2::new(1e-5, 0.0), DVec2::new(0.3, -0.4), DVec2::new(-1.1, 0.9)] {
                let r2 = point.length_squared();
                let (factor, slope) = projection.factor(r2);
                let back = projection.ray(point * factor).expect("a ray");
                assert!(back.distance(point) < 1e-12, "{projection:?} {point}: {back}");
                let step = 1e-4 * r2.max(1e-9);
                let numeric = (projection.factor(r2 + step).0 - projection.factor(r2).0) / step;
                assert!((numeric - slope).abs() < 1e-3 || r2 < 1e-6, "{projection:?} {point}: {slope} {numeric}");
            }
        }
        assert_eq!(Projection::Fisheye.ray(DVec2::new(FRAC_PI_2, 0.0)), None);
        assert_eq!(Projection::Fov(2.0).ray(DVec2::new(0.8, 0.0)), None);
    }

    #[test]
    fn undistort_returns_none_beyond_the_fold() {
        let lens = Lens { radial: [-0.5, 0.0, 0.0, 0.0, 0.0, 0.0], ..Lens::default() };
        // x (1 - x^2 / 2) is largest at sqrt(2/3): 0.544.
        assert!(lens.undistort([0.54, 0.0]).is_some());
        assert_eq!(lens.undistort([0.55, 0.0]), None);
        assert!(lens.is_invertible_at([0.81, 0.0]) && !lens.is_invertible_at([0.82, 0.0]));
        let wild = Lens { radial: [1e300, -1e300, f64::MAX, 0.0, 0.0, 0.0], tangential: [1e200, 0.0], ..lens };
        assert_eq!(wild.undistort([0.5, 0.5]), None);
    }

    #[test]
    fn bad_coefficients_are_named_and_opencv_lenses_take_the_short_formula() {
        let message = |lens: Lens| lens.validate().unwrap_err().to_string();
        let bad_p2 = Lens { tangential: [0.0, f64::NAN], ..PHONE };
        assert_eq!(message(bad_p2), "bad camera: p2 is NaN, expected a finite number");
        let wide = Lens { projection: Projection::Fov(3.2), ..Lens::default() };
        assert_eq!(message(wide), "bad camera: omega is 3.2, expected an angle between 0 and pi");
        assert!(PHONE.is_opencv() && !Lens { divisor: [0.1, 0.0, 0.0], ..PHONE }.is_opencv());
        let ([x, y], [fast_x, fast_y]) = (PHONE.distort([0.3, -0.2]), PHONE.distort_opencv([0.3, -0.2]));
        assert!((x - fast_x).abs() < 1e-15 && (y - fast_y).abs() < 1e-15);
        assert!(PHONE.validate().is_ok() && !PHONE.is_pinhole() && Lens::default().is_pinhole());
    }

    proptest! {
        #[test]
        fn undistort_inverts_distort(
            x in -0.7..0.7, y in -0.7..0.7, k1 in -0.2..0.2, k2 in -0.05..0.05, p in -0.01..0.01, fisheye: bool,
        ) {
            let projection = if fisheye { Projection::Fisheye } else { Projection::Perspective };
            let radial = [k1, k2, 0.0, 0.0, 0.0, 0.0];
            let lens = Lens { projection, radial, tangential: [p, -p / 2.0], ..Lens::default() };
            let ray = lens.undistort(lens.distort([x, y]));
            // No lens folds over: at r^2 <= 0.98 the radial slope is at least 1 - 0.6 r^2 - 0.25 r^4 = 0.17, the tangential one
            // at most 0.09 (six times 0.01 r and half of it).
            let [u, v] = ray.expect("a ray");
            prop_assert!((u - x).abs() < 1e-9 && (v - y).abs() < 1e-9, "{u} {v}");
        }
    }
}
