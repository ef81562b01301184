//! Cameras and images of a COLMAP model. Poses are world to camera with OpenCV's axes.

use std::collections::HashMap;

use clift_core::{Intrinsics, IntrinsicsNorm, Pose};
use glam::{DMat3, DQuat, DVec3};

use crate::error::DataError;
use crate::geometry::lens::{Lens, MODELS};
use crate::sources::photos::photo::MAX_FRAMES;

/// Largest number of cameras of a model: one per image.
const MAX_CAMERAS: usize = MAX_FRAMES;
/// Longest name of an image, in bytes.
pub(crate) const MAX_NAME_BYTES: usize = 4096;

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ColmapCamera {
    pub model: String,
    pub width: u64,
    pub height: u64,
    pub params: Vec<f64>,
}

impl ColmapCamera {
    pub fn optics(&self) -> Result<(IntrinsicsNorm, Lens), String> {
        let name = self.model.to_ascii_uppercase();
        let known = MODELS.iter().find(|(model, num_focal, _)| *model == name && *num_focal > 0);
        let &(_, num_focal, num_distortion) = known.ok_or_else(|| {
            let names: Vec<_> =
                MODELS.iter().filter(|(_, num_focal, _)| *num_focal > 0).map(|(name, ..)| *name).collect();
            format!("the model is {}, expected one of {}", self.model, names.join(", "))
        })?;
        let params = &self.params;
        let expected = num_focal + 2 + num_distortion;
        let wrong_number = || format!("{name} has {} parameters, expected {expected}", params.len());
        if params.len() != expected {
            return Err(wrong_number());
        }
        let (focal, centre) = ([params[0], params[num_focal - 1]], &params[num_focal..num_focal + 2]);
        let lens = Lens::from_colmap(&name, &params[num_focal + 2..]).ok_or_else(wrong_number)?;
        if self.width == 0 || self.height == 0 {
            return Err(format!("the size is {}x{} pixels", self.width, self.height));
        }
        let intrinsics = Intrinsics { fx: focal[0], fy: focal[1], cx: centre[0], cy: centre[1] };
        let intrinsics_norm = IntrinsicsNorm::from_pixels(intrinsics, self.width as f64, self.height as f64);
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

#[derive(Debug, Default, PartialEq)]
pub(crate) struct Model {
    /// Cameras by id, or what is wrong with their entries: a camera that no image uses may be malformed.
    pub cameras: HashMap<u32, Result<ColmapCamera, String>>,
    /// Images in file order.
    pub images: Vec<ColmapImage>,
    /// Names and reasons of the images that are malformed.
    pub malformed: Vec<(String, String)>,
}

impl Model {
    /// Adds a camera; refuses more than [`MAX_CAMERAS`].
    pub fn add_camera(&mut self, id: u32, camera: Result<ColmapCamera, String>) -> Result<(), String> {
        if self.cameras.len() == MAX_CAMERAS {
            return Err(format!("more than {MAX_CAMERAS} cameras"));
        }
        let twice = || Err("its id occurs twice".into());
        self.cameras.entry(id).and_modify(|first| *first = twice()).or_insert(camera);
        Ok(())
    }

    /// Adds an image, or its name and why it is malformed; refuses more than [`MAX_FRAMES`].
    pub fn add_image(&mut self, image: Result<ColmapImage, (String, String)>) -> Result<(), String> {
        if self.images.len() + self.malformed.len() == MAX_FRAMES {
            return Err(format!("more than {MAX_FRAMES} images"));
        }
        match image {
            Ok(image) => self.images.push(image),
            Err(malformed) => self.malformed.push(malformed),
        }
        Ok(())
    }
}
