//! The ray of every pixel: Plücker coordinates (paper section 3.1; moment first), or a direction.
// B scenes, V views, H rows, W columns

use burn::tensor::{Int, Tensor, assert_shape};
use serde::{Deserialize, Serialize};
use strum::Display;

use crate::ops::matmul::matmul_without_gradient;
use crate::views::upload::Cameras;

/// Frame of the rays that are inputs of the networks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, Display)]
#[serde(rename_all = "lowercase")]
#[strum(serialize_all = "lowercase")]
pub enum RayFrame {
    /// Plücker coordinates in the frame of the scene (paper section 3.1).
    #[default]
    World,
    /// Directions in the frame of the view's own camera ("`CamRay`" of `PRoPE`, arXiv 2507.10496). With camera-relative
    /// attention a network then depends on relative poses alone.
    Camera,
}

impl RayFrame {
    pub(crate) fn num_coordinates(self) -> usize {
        match self {
            Self::World => 6,
            Self::Camera => 3,
        }
    }
}

/// Computes the ray of every pixel in the frame of the scene ([`plucker`]) or of its camera.
///
/// # Shapes
/// - returns `[batch, views, height, width, 6]`, or 3 values in the frame of the camera
pub fn rays(cameras: &Cameras, frame: RayFrame) -> Tensor<5> {
    match frame {
        RayFrame::World => plucker(cameras),
        RayFrame::Camera => camera_rays(cameras),
    }
}

/// Computes the ray of every pixel as `[moment, direction]`: `moment = origin x direction`, and the unit `direction` in
/// the world frame through the center of the pixel, `(column + 0.5, row + 0.5)`.
///
/// # Shapes
/// - returns `[batch, views, height, width, 6]`
pub fn plucker(cameras: &Cameras) -> Tensor<5> {
    let [batch, views] = cameras.dims();
    let (height, width) = (cameras.height, cameras.width);
    let pose = |rows: usize, columns: std::ops::Range<usize>| {
        cameras.c2w.clone().slice([0..batch, 0..views, rows..rows + 1, columns])
    };
    let [rotation, origin] = [0..3, 3..4].map(|columns| [0, 1, 2].map(|row| pose(row, columns.clone())));
    // Moment and direction are products of a matrix and the direction in the frame of the camera: `origin x rotation` and
    // `rotation`. `moment` returns a row of the first.
    let moment = |i: usize, j: usize| origin[i].clone() * rotation[j].clone() - origin[j].clone() * rotation[i].clone();
    let to_ray = Tensor::cat([vec![moment(1, 2), moment(2, 0), moment(0, 1)], rotation.to_vec()].concat(), 2);
    let camera_ray = camera_rays(cameras).reshape([batch, views, height * width, 3]);
    let rays = matmul_without_gradient(camera_ray, to_ray.swap_dims(2, 3));
    rays.reshape([batch, views, height, width, 6])
}

/// Computes the unit direction of every pixel's ray in the frame of its camera.
///
/// # Shapes
/// - returns `[batch, views, height, width, 3]`
fn camera_rays(cameras: &Cameras) -> Tensor<5> {
    let [batch, views] = cameras.dims();
    let (height, width) = (cameras.height, cameras.width);
    assert_shape!(cameras.intrinsics, [batch, views, 4]);

    let intrinsic = |index: usize| cameras.intrinsics.clone().narrow(2, index, 1).reshape([batch, views, 1, 1, 1]);
    let [fx, fy, cx, cy] = [0, 1, 2, 3].map(intrinsic);
    let device = cameras.c2w.device();
    let dtype = cameras.c2w.dtype();
    let centers = |count: usize, shape: [usize; 5]| {
        Tensor::<1, Int>::arange(0..count as i64, &device).float().cast(dtype).add_scalar(0.5).reshape(shape)
    };
    let x = (centers(width, [1, 1, 1, width, 1]) - cx) / fx;
    let y = (centers(height, [1, 1, height, 1, 1]) - cy) / fy;
    let unit = |axis: usize| {
        let ones = [0, 1, 2].map(|other| f32::from(u8::from(other == axis)));
        Tensor::<1>::from_floats(ones, &device).cast(dtype).reshape([1, 1, 1, 1, 3])
    };
    // The third coordinate is 1, so that the length is at least 1.
    let length = (x.clone().square() + y.clone().square()).add_scalar(1.0).sqrt();
    (x * unit(0) + (y * unit(1) + unit(2))) / length
}

#[cfg(test)]
mod tests {
    use burn::tensor::DType;

    use super::*;
    use crate::testing::{Fixture, assert_close, devices};

    #[test]
    fn rays_equal_pytorch_in_f32_and_f64() {
        let fixture = Fixture::open("rays");
        for device in devices() {
            for dtype in [DType::F32, DType::F64] {
                let rays = plucker(&fixture.cameras("", &device, dtype));
                assert_eq!(rays.dtype(), dtype);
                // f32 against f64: a few roundings of values up to 2.
                assert_close(&rays, &fixture.tensor_f64::<5>("output.plucker", &device), 2e-6);
            }
        }
    }
}
