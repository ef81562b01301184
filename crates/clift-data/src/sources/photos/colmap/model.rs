//! Cameras and images of a COLMAP model. Poses are world to camera with OpenCV's axes.

use std::collections::HashMap;

use clift_core::{Intrinsics, IntrinsicsNorm, Pose};
use glam::{DMat3, DQuat, DVec3};

use crate::error::DataError;
use crate::geometry::lens::Lens;
use crate::sources::photos::photo::MAX_FRAMES;

/// Largest number of cameras of a model: one per image.
const MAX_CAMERAS: usize = MAX_FRAMES;
/// Longest name of an image, in bytes.
pub(crate) const MAX_NAME_BYTES: usize = 4096;

/// Names of COLMAP's camera models and their numbers of parameters, by model id.
pub(crate) const MODELS: [(&str, usize); 11] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
];

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ColmapCamera {
    pub model: String,
    pub width: u64,
    pub height: u64,
    pub params: Vec<f64>,
}

impl ColmapCamera {
    pub fn optics(&self) -> Result<(IntrinsicsNorm, Lens), String> {
        let (focal, centre, distortion) = match (self.model.as_str(), self.params.as_slice()) {
            ("SIMPLE_PINHOLE", &[f, cx, cy]) => ([f, f], [cx, cy], [0.0; 4]),
            ("PINHOLE", &[fx, fy, cx, cy]) => ([fx, fy], [cx, cy], [0.0; 4]),
            ("SIMPLE_RADIAL", &[f, cx, cy, k]) => ([f, f], [cx, cy], [k, 0.0, 0.0, 0.0]),
            ("RADIAL", &[f, cx, cy, k1, k2]) => ([f, f], [cx, cy], [k1, k2, 0.0, 0.0]),
            ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => ([fx, fy], [cx, cy], [k1, k2, p1, p2]),
            (model, params) => {
                return Err(match MODELS.iter().find(|(name, _)| *name == model) {
                    Some((_, count)) if *count != params.len() => {
                        format!("{model} has {} parameters, expected {count}", params.len())
                    }
                    _ => format!(
                        "the model is {model}, expected SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL or OPENCV; \
                         `colmap image_undistorter` converts every model to PINHOLE"
                    ),
                });
            }
        };
        if self.width == 0 || self.height == 0 {
            return Err(format!("the size is {}x{} pixels", self.width, self.height));
        }
        let intrinsics = Intrinsics { fx: focal[0], fy: focal[1], cx: centre[0], cy: centre[1] };
        let intrinsics_norm = IntrinsicsNorm::from_pixels(intrinsics, self.width as f64, self.height as f64);
        let [k1, k2, p1, p2] = distortion;
        let lens = Lens { radial: [k1, k2, 0.0], tangential: [p1, p2] };
        let checked = intrinsics_norm.validate().and_then(|()| lens.validate());
        checked.map(|()| (intrinsics_norm, lens)).map_err(|error| error.to_string())
    }
}

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ColmapImage {
    pub name: String,
    pub camera_id: u32,
    /// World to camera: quaternion `w x y z`, then translation.
    pub w2c: [f64; 7],
}

impl ColmapImage {
    pub fn c2w(&self) -> Result<Pose, DataError> {
        let bad = DataError::bad_camera;
        if let Some(value) = self.w2c.iter().find(|value| !value.is_finite()) {
            return Err(bad(format!("the pose holds {value}")));
        }
        let [w, x, y, z, tx, ty, tz] = self.w2c;
        let quaternion = DQuat::from_xyzw(x, y, z, w);
        let length = quaternion.length();
        if !(0.9..1.1).contains(&length) {
            return Err(bad(format!("the quaternion has length {length:.3}, expected 1")));
        }
        Ok(Pose { rotation: DMat3::from_quat(quaternion / length), translation: DVec3::new(tx, ty, tz) }.inverse())
    }
}

/// Cameras by id, and images in file order.
#[derive(Debug, Default, PartialEq)]
pub(crate) struct Model {
    pub cameras: HashMap<u32, ColmapCamera>,
    pub images: Vec<ColmapImage>,
}

/// Adds a camera; refuses a second one of the same id, and more than [`MAX_CAMERAS`].
pub(crate) fn add_camera(
    cameras: &mut HashMap<u32, ColmapCamera>,
    id: u32,
    camera: ColmapCamera,
) -> Result<(), String> {
    if cameras.len() == MAX_CAMERAS {
        return Err(format!("more than {MAX_CAMERAS} cameras"));
    }
    match cameras.insert(id, camera) {
        None => Ok(()),
        Some(_) => Err(format!("camera {id} occurs twice")),
    }
}

/// Adds an image; refuses more than [`MAX_FRAMES`].
pub(crate) fn add_image(images: &mut Vec<ColmapImage>, image: ColmapImage) -> Result<(), String> {
    if images.len() == MAX_FRAMES {
        return Err(format!("more than {MAX_FRAMES} images"));
    }
    images.push(image);
    Ok(())
}
