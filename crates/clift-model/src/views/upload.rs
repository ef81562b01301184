//! Copies images and cameras to a device.
// B scenes, V views, H rows, W columns

use burn::tensor::{Device, Tensor, TensorData};

use crate::error::ModelError;

/// Cameras of several views of several scenes, in the normalized frame of each scene.
#[derive(Clone, Debug)]
pub struct Cameras {
    /// Height of every view in pixels.
    pub height: usize,
    /// Width of every view in pixels.
    pub width: usize,
    /// Camera-to-world poses, OpenCV axes, `[batch, views, 4, 4]`.
    pub c2w: Tensor<4>,
    /// `fx, fy, cx, cy` in pixels, `[batch, views, 4]`.
    pub intrinsics: Tensor<3>,
}

/// Images with cameras, of several scenes.
#[derive(Clone, Debug)]
pub struct Views {
    /// RGB in `[0, 1]`, `[batch, views, height, width, 3]`.
    pub images: Tensor<5>,
    /// The camera of every image.
    pub cameras: Cameras,
}

impl Cameras {
    /// Copies cameras to a device.
    ///
    /// # Shapes
    /// - `c2w`: `[batch, views, 4, 4]` row-major, `intrinsics`: `[batch, views, 4]` (`fx, fy, cx, cy` in pixels)
    /// - `shape`: `[batch, views, height, width]`
    ///
    /// # Errors
    /// [`ModelError::WrongLength`] and [`ModelError::NotFinite`].
    pub fn upload(c2w: &[f32], intrinsics: &[f32], shape: [usize; 4], device: &Device) -> Result<Self, ModelError> {
        let [batch, views, height, width] = shape;
        check_length("c2w", c2w.len(), batch * views * 16)?;
        check_length("intrinsics", intrinsics.len(), batch * views * 4)?;
        check_finite("c2w", c2w)?;
        check_finite("intrinsics", intrinsics)?;
        Ok(Self {
            height,
            width,
            c2w: Tensor::from_data(TensorData::new(c2w.to_vec(), [batch, views, 4, 4]), device),
            intrinsics: Tensor::from_data(TensorData::new(intrinsics.to_vec(), [batch, views, 4]), device),
        })
    }

    /// Returns `[batch, views]`.
    pub fn dims(&self) -> [usize; 2] {
        let [batch, views, _, _] = self.c2w.dims();
        [batch, views]
    }
}

impl Views {
    /// Copies 8-bit images and their cameras to a device; pixels are scaled to `[0, 1]`.
    ///
    /// # Shapes
    /// - `images`: `[batch, views, height, width, 3]`; the others as [`Cameras::upload`]
    ///
    /// # Errors
    /// [`ModelError::WrongLength`] and [`ModelError::NotFinite`].
    pub fn upload(
        images: &[u8],
        c2w: &[f32],
        intrinsics: &[f32],
        shape: [usize; 4],
        device: &Device,
    ) -> Result<Self, ModelError> {
        let cameras = Cameras::upload(c2w, intrinsics, shape, device)?;
        Ok(Self { images: upload_images(images, shape, device)?, cameras })
    }
}

/// Copies 8-bit images to a device as RGB in `[0, 1]`.
///
/// # Shapes
/// - `images` and the result: `[batch, views, height, width, 3]`, with `shape` = `[batch, views, height, width]`
///
/// # Errors
/// [`ModelError::WrongLength`].
pub fn upload_images(images: &[u8], shape: [usize; 4], device: &Device) -> Result<Tensor<5>, ModelError> {
    let [batch, views, height, width] = shape;
    check_length("images", images.len(), batch * views * height * width * 3)?;
    let values: Vec<f32> = images.iter().map(|&value| f32::from(value) / 255.0).collect();
    Ok(Tensor::from_data(TensorData::new(values, [batch, views, height, width, 3]), device))
}

fn check_length(name: &'static str, got: usize, expected: usize) -> Result<(), ModelError> {
    if got == expected { Ok(()) } else { Err(ModelError::WrongLength { name, expected, got }) }
}

fn check_finite(name: &'static str, values: &[f32]) -> Result<(), ModelError> {
    match values.iter().position(|value| !value.is_finite()) {
        Some(position) => Err(ModelError::NotFinite { name, value: values[position], position }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrong_lengths_and_nan_are_refused() {
        let device = Device::flex();
        let error = Cameras::upload(&[0.0; 15], &[0.0; 4], [1, 1, 8, 8], &device).unwrap_err();
        assert_eq!(error.to_string(), "c2w: expected 16 values for the shape, got 15");
        let mut pose = [0.0; 16];
        pose[3] = f32::NAN;
        let error = Cameras::upload(&pose, &[0.0; 4], [1, 1, 8, 8], &device).unwrap_err();
        assert_eq!(error.to_string(), "c2w holds NaN at position 3");
        assert!(Views::upload(&[0; 191], &[0.0; 16], &[0.0; 4], [1, 1, 8, 8], &device).is_err());
    }
}
