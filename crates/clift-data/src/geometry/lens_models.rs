//! COLMAP's camera models by name.

use crate::geometry::lens::{Lens, Projection};

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
