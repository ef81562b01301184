//! Copies images and cameras to a device.
// B scenes, V views, H rows, W columns

use burn::tensor::{DType, Device, Int, Tensor, TensorData};
use clift_core::{Camera, ClipViews};

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
    /// Copies the cameras of views to a device, one set of views per scene, of the same number and size.
    pub fn upload(scenes: &[&ClipViews], device: &Device) -> Result<Self, ModelError> {
        Self::of_cameras(scenes.iter().flat_map(|views| &views.cameras), shape(scenes), device)
    }

    /// Copies the cameras of one scene to a device, for images of `height` by `width` pixels.
    pub fn of_views(views: &[Camera], height: usize, width: usize, device: &Device) -> Result<Self, ModelError> {
        Self::of_cameras(views, [1, views.len(), height, width], device)
    }

    fn of_cameras<'a>(
        cameras: impl IntoIterator<Item = &'a Camera>,
        [batch, views, height, width]: [usize; 4],
        device: &Device,
    ) -> Result<Self, ModelError> {
        let (mut c2w, mut intrinsics) = (Vec::new(), Vec::new());
        for camera in cameras {
            c2w.extend(camera.c2w.to_matrix_f64().map(|value| value as f32));
            intrinsics.extend(camera.intrinsics.to_array().map(|value| value as f32));
        }
        check_length("cameras", c2w.len() / 16, batch * views)?;
        for (name, values) in [("c2w", &c2w), ("intrinsics", &intrinsics)] {
            if let Some(position) = values.iter().position(|value: &f32| !value.is_finite()) {
                return Err(ModelError::NotFinite { name, value: values[position], position });
            }
        }
        Ok(Self {
            height,
            width,
            c2w: Tensor::from_data(TensorData::new(c2w, [batch, views, 4, 4]), device),
            intrinsics: Tensor::from_data(TensorData::new(intrinsics, [batch, views, 4]), device),
        })
    }

    /// Returns `[batch, views]`.
    pub fn dims(&self) -> [usize; 2] {
        let [batch, views, _, _] = self.c2w.dims();
        [batch, views]
    }
}

impl Views {
    /// Copies images and cameras to a device, as [`upload_images`] and [`Cameras::upload`].
    pub fn upload(scenes: &[&ClipViews], device: &Device) -> Result<Self, ModelError> {
        Ok(Self { images: upload_images(scenes, device)?, cameras: Cameras::upload(scenes, device)? })
    }
}

/// Copies images to a device as RGB in `[0, 1]`, `[batch, views, height, width, 3]`, the same bits on every device. Scenes have
/// sets of the same number of views of the same size.
pub fn upload_images(scenes: &[&ClipViews], device: &Device) -> Result<Tensor<5>, ModelError> {
    let [batch, views, height, width] = shape(scenes);
    let images = scenes.iter().map(|views| &views.images[..]).collect::<Vec<_>>().concat();
    check_length("images", images.len(), batch * views * height * width * 3)?;
    let shape = [batch, views, height, width, 3];
    // Flex computes in the host's memory: nothing has to be moved.
    if *device != Device::flex() {
        return Ok(upload_packed(&images, device).reshape(shape));
    }
    let values: Vec<f32> = images.into_iter().map(unit).collect();
    Ok(Tensor::from_data(TensorData::new(values, shape), device))
}

/// Returns `[batch, views, height, width]` from the first scene; the uploads check the other scenes.
fn shape(scenes: &[&ClipViews]) -> [usize; 4] {
    scenes.first().map_or([0; 4], |first| [scenes.len(), first.num_views(), first.height, first.width])
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

#[cfg(test)]
mod tests {
    use clift_core::{Intrinsics, Pose};

    use super::*;
    use crate::testing::devices;

    /// Returns views of 19 x 1 pixels.
    fn views(count: usize, images: &[u8]) -> ClipViews {
        let intrinsics = Intrinsics { fx: 19.0, fy: 19.0, cx: 9.5, cy: 0.5 };
        ClipViews {
            width: 19,
            height: 1,
            images: images.to_vec(),
            cameras: vec![Camera { c2w: Pose::IDENTITY, intrinsics }; count],
            frame_index: (0..count).collect(),
        }
    }

    #[test]
    fn pixels_have_the_same_bits_on_every_device() {
        // All 256 values, and a number that no word divides.
        let bytes: Vec<u8> = (0..=u8::MAX).rev().chain(0..29).collect();
        let expected: Vec<u32> = bytes.iter().map(|&byte| (f32::from(byte) / 255.0).to_bits()).collect();
        for device in devices() {
            let bits = |values: Vec<f32>| values.into_iter().map(f32::to_bits).collect::<Vec<_>>();
            let images = upload_images(&[&views(5, &bytes)], &device).expect("285 values");
            assert_eq!(bits(images.try_into_vec_as().expect("f32")), expected, "{device:?}");
            let packed = upload_packed(&bytes, &device.clone().autodiff());
            assert_eq!(bits(packed.inner().try_into_vec_as().expect("f32")), expected, "{device:?}");
        }
    }

    #[test]
    fn wrong_lengths_and_nan_are_refused() {
        let device = Device::flex();
        let error = Cameras::upload(&[&views(2, &[]), &views(1, &[])], &device).unwrap_err();
        assert_eq!(error.to_string(), "cameras: expected 4 values for the shape, got 3");
        let mut broken = views(1, &[0; 57]);
        broken.cameras[0].c2w.translation.x = f64::NAN;
        let error = Views::upload(&[&broken], &device).unwrap_err();
        assert_eq!(error.to_string(), "c2w holds NaN at position 3");
        assert!(Views::upload(&[&views(1, &[0; 56])], &device).is_err());
    }
}
