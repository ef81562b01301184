//! Copies images and cameras to a device.
// B scenes, V views, H rows, W columns

use burn::tensor::{DType, Device, Int, Tensor, TensorData};

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

/// Copies 8-bit images to a device as RGB in `[0, 1]`, the same bits on every device.
///
/// # Shapes
/// - `images` and the result: `[batch, views, height, width, 3]`, with `shape` = `[batch, views, height, width]`
///
/// # Errors
/// [`ModelError::WrongLength`].
pub fn upload_images(images: &[u8], shape: [usize; 4], device: &Device) -> Result<Tensor<5>, ModelError> {
    let [batch, views, height, width] = shape;
    check_length("images", images.len(), batch * views * height * width * 3)?;
    let shape = [batch, views, height, width, 3];
    // Flex computes in the host's memory: nothing has to be moved.
    if *device != Device::flex() {
        return Ok(upload_packed(images, device).reshape(shape));
    }
    let values: Vec<f32> = images.iter().copied().map(unit).collect();
    Ok(Tensor::from_data(TensorData::new(values, shape), device))
}

fn unit(value: u8) -> f32 {
    f32::from(value) / 255.0
}

/// Copies four values a word, a quarter of the bytes of f32, and scales them on the device: by a table, because divisions
/// of GPUs need not be exact to the last bit.
fn upload_packed(bytes: &[u8], device: &Device) -> Tensor<1> {
    let table: Vec<f32> = (0..=u8::MAX).map(unit).collect();
    let table: Tensor<1> = Tensor::from_data(TensorData::new(table, [256]), device);
    let mut words = vec![0_i32; bytes.len().div_ceil(4)];
    for (word, chunk) in words.iter_mut().zip(bytes.chunks(4)) {
        *word = chunk.iter().rev().fold(0, |word, &byte| word << 8 | i32::from(byte));
    }
    let count = words.len();
    let words: Tensor<2, Int> = Tensor::from_data(TensorData::new(words, [count, 1]), (device, DType::I32));
    let shifts: Tensor<2, Int> = Tensor::from_data([[0, 8, 16, 24]], (device, DType::I32));
    let values = words.bitwise_right_shift(shifts).bitwise_and_scalar(255).reshape([4 * count]);
    table.select(0, values.narrow(0, 0, bytes.len()))
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
    use crate::testing::devices;

    #[test]
    fn pixels_have_the_same_bits_on_every_device() {
        // All 256 values, and a number that no word divides.
        let bytes: Vec<u8> = (0..=u8::MAX).rev().chain(0..29).collect();
        let expected: Vec<u32> = bytes.iter().map(|&byte| (f32::from(byte) / 255.0).to_bits()).collect();
        for device in devices() {
            let bits = |values: Vec<f32>| values.into_iter().map(f32::to_bits).collect::<Vec<_>>();
            let images = upload_images(&bytes, [1, 5, 1, 19], &device).expect("285 values");
            assert_eq!(bits(images.try_into_vec_as().expect("f32")), expected, "{device:?}");
            let packed = upload_packed(&bytes, &device.clone().autodiff());
            assert_eq!(bits(packed.inner().try_into_vec_as().expect("f32")), expected, "{device:?}");
        }
    }

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
