//! Lens distortion in the models of OpenCV, nerfstudio and COLMAP, and COLMAP's camera models by name.

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
    /// Returns the factor from a ray `(x, y, 1)` to its projection at `r2 = x^2 + y^2`.
    fn factor(self, r2: f64) -> f64 {
        match self {
            Self::Perspective => 1.0,
            Self::Fisheye => arctangent_factor(r2),
            Self::Fov(omega) => {
                let width = 2.0 * (omega / 2.0).tan();
                width / omega * arctangent_factor(width * width * r2)
            }
            Self::Division(k) => 2.0 / (1.0 + (1.0 - 4.0 * k * r2).sqrt()),
            Self::Eucm(alpha, beta) => 1.0 / (alpha * (beta * r2 + 1.0).sqrt() + 1.0 - alpha),
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
            Projection::Fov(omega) => vec![omega],
            Projection::Division(k) => vec![k],
            Projection::Eucm(alpha, beta) => vec![alpha, beta],
        };
        let names = ["k1", "k2", "k3", "k4", "k5", "k6", "k4", "k5", "k6", "p1", "p2", "s1", "s2", "s3", "s4"];
        let values = [&self.radial[..], &self.divisor, &self.tangential, &self.prism].concat();
        let projection = projection.into_iter().map(|value| ("the parameter of the projection", value));
        for (name, value) in names.into_iter().zip(values).chain(projection) {
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
        self.distort_projected(ray * self.projection.factor(ray.length_squared())).into()
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

    fn shift(&self, at: DVec2) -> DVec2 {
        let ([s1, s2, s3, s4], r2) = (self.prism, at.length_squared());
        self.tangential(at) + DVec2::new(r2 * (s1 + r2 * s2), r2 * (s3 + r2 * s4))
    }

    fn tangential(&self, at: DVec2) -> DVec2 {
        let (DVec2 { x, y }, [p1, p2]) = (at, self.tangential);
        let (r2, mixed) = (at.length_squared(), 2.0 * x * y);
        DVec2::new(p1 * mixed + p2 * (r2 + 2.0 * x * x), p1 * (r2 + 2.0 * y * y) + p2 * mixed)
    }

    fn distort_projected(&self, projected: DVec2) -> DVec2 {
        let radial = projected * self.radial_factor(projected.length_squared()).0;
        radial + self.shift(if self.radial_first { radial } else { projected })
    }

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
        let projected = ray * self.projection.factor(ray.length_squared());
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

/// Names of COLMAP's camera models by model id, with their numbers of focal lengths and of distortion parameters. The
/// principal point lies between these two. Panoramas (`EQUIRECTANGULAR`) have neither focal lengths nor a lens.
pub(crate) const MODELS: [(&str, usize, usize); 18] = [
    ("SIMPLE_PINHOLE", 1, 0),
    ("PINHOLE", 2, 0),
    ("SIMPLE_RADIAL", 1, 1),
    ("RADIAL", 1, 2),
    ("OPENCV", 2, 4),
    ("OPENCV_FISHEYE", 2, 4),
    ("FULL_OPENCV", 2, 8),
    ("FOV", 2, 1),
    ("SIMPLE_RADIAL_FISHEYE", 1, 1),
    ("RADIAL_FISHEYE", 1, 2),
    ("THIN_PRISM_FISHEYE", 2, 8),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 2, 12),
    ("SIMPLE_DIVISION", 1, 1),
    ("DIVISION", 2, 1),
    ("SIMPLE_FISHEYE", 1, 0),
    ("FISHEYE", 2, 0),
    ("EUCM", 2, 2),
    ("EQUIRECTANGULAR", 0, 0),
];

impl Lens {
    /// Returns the lens of a COLMAP model, its name in any case; `distortion` are the parameters that follow the
    /// principal point. `None` for another name, another number of parameters, and panoramas.
    pub fn from_colmap(model: &str, distortion: &[f64]) -> Option<Self> {
        let fisheye = Self { projection: Projection::Fisheye, ..Self::default() };
        let projected = |projection: Projection| Self { projection, ..Self::default() };
        Some(match (model.to_ascii_uppercase().as_str(), distortion) {
            ("SIMPLE_PINHOLE" | "PINHOLE", &[]) | ("FOV", &[0.0]) => Self::default(),
            ("SIMPLE_RADIAL", &[k]) => Self { radial: [k, 0.0, 0.0, 0.0, 0.0, 0.0], ..Self::default() },
            ("RADIAL", &[k1, k2]) => Self { radial: [k1, k2, 0.0, 0.0, 0.0, 0.0], ..Self::default() },
            ("OPENCV", &[k1, k2, p1, p2]) => {
                Self { radial: [k1, k2, 0.0, 0.0, 0.0, 0.0], tangential: [p1, p2], ..Self::default() }
            }
            ("FULL_OPENCV", &[k1, k2, p1, p2, k3, k4, k5, k6]) => Self {
                radial: [k1, k2, k3, 0.0, 0.0, 0.0],
                divisor: [k4, k5, k6],
                tangential: [p1, p2],
                ..Self::default()
            },
            ("FOV", &[omega]) => projected(Projection::Fov(omega)),
            ("SIMPLE_DIVISION" | "DIVISION", &[k]) => projected(Projection::Division(k)),
            ("EUCM", &[alpha, beta]) => projected(Projection::Eucm(alpha, beta)),
            ("SIMPLE_FISHEYE" | "FISHEYE", &[]) => fisheye,
            ("SIMPLE_RADIAL_FISHEYE", &[k]) => Self { radial: [k, 0.0, 0.0, 0.0, 0.0, 0.0], ..fisheye },
            ("RADIAL_FISHEYE", &[k1, k2]) => Self { radial: [k1, k2, 0.0, 0.0, 0.0, 0.0], ..fisheye },
            ("OPENCV_FISHEYE", &[k1, k2, k3, k4]) => Self { radial: [k1, k2, k3, k4, 0.0, 0.0], ..fisheye },
            ("THIN_PRISM_FISHEYE", &[k1, k2, p1, p2, k3, k4, sx, sy]) => {
                Self { radial: [k1, k2, k3, k4, 0.0, 0.0], tangential: [p1, p2], prism: [sx, 0.0, sy, 0.0], ..fisheye }
            }
            ("RAD_TAN_THIN_PRISM_FISHEYE", &[k0, k1, k2, k3, k4, k5, p0, p1, s0, s1, s2, s3]) => Self {
                radial: [k0, k1, k2, k3, k4, k5],
                tangential: [p1, p0],
                prism: [s0, s1, s2, s3],
                radial_first: true,
                ..fisheye
            },
            _ => return None,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
}
