//! Plücker coordinates of every pixel's ray (paper section 3.1; moment first).
// B scenes, V views, H rows, W columns

use burn::tensor::{Int, Tensor, assert_shape};

use crate::views::upload::Cameras;

/// Gives every pixel its ray as `[moment, direction]`: `moment = origin x direction`, `direction` of
/// unit length in the world frame, through the pixel's centre at `(column + 0.5, row + 0.5)`.
///
/// # Shapes
/// - returns `[batch, views, height, width, 6]`
pub fn plucker(cameras: &Cameras) -> Tensor<5> {
    let [batch, views] = cameras.dims();
    let (height, width) = (cameras.height, cameras.width);
    assert_shape!(cameras.intrinsics, [batch, views, 4]);
    let grid = [batch, views, height, width, 1];

    let intrinsic = |index: usize| cameras.intrinsics.clone().narrow(2, index, 1).reshape([batch, views, 1, 1, 1]);
    let [fx, fy, cx, cy] = [0, 1, 2, 3].map(intrinsic);
    let device = cameras.c2w.device();
    let dtype = cameras.c2w.dtype();
    let centres = |count: usize, shape: [usize; 5]| {
        let index = Tensor::<1, Int>::arange(0..count as i64, &device);
        index.float().cast(dtype).add_scalar(0.5).reshape(shape)
    };
    let x = ((centres(width, [1, 1, 1, width, 1]) - cx) / fx).expand(grid);
    let y = ((centres(height, [1, 1, height, 1, 1]) - cy) / fy).expand(grid);
    let z = x.ones_like();
    // The third coordinate is 1, so the length is at least 1 and needs no guard.
    let camera_ray = Tensor::cat(vec![x, y, z], 4);
    let length = camera_ray.clone().square().sum_dim(4).sqrt();
    let camera_ray = (camera_ray / length).reshape([batch, views, height * width, 3]);

    let rotation = cameras.c2w.clone().slice([0..batch, 0..views, 0..3, 0..3]);
    let direction = camera_ray.matmul(rotation.swap_dims(2, 3)).reshape([batch, views, height, width, 3]);
    let origin = cameras.c2w.clone().slice([0..batch, 0..views, 0..3, 3..4]);
    let origin = origin.reshape([batch, views, 1, 1, 3]).expand([batch, views, height, width, 3]);
    Tensor::cat(vec![cross(origin, direction.clone()), direction], 4)
}

/// Cross product along the last dimension, composed of operations every device has.
fn cross(a: Tensor<5>, b: Tensor<5>) -> Tensor<5> {
    let part = |t: &Tensor<5>, i: usize| t.clone().narrow(4, i, 1);
    let component = |i: usize, j: usize| part(&a, i) * part(&b, j) - part(&a, j) * part(&b, i);
    Tensor::cat(vec![component(1, 2), component(2, 0), component(0, 1)], 4)
}

#[cfg(test)]
mod tests {
    use burn::tensor::{Device, TensorData};

    use super::*;
    use crate::testing::{Fixture, assert_close, devices, to_vec};

    #[test]
    fn rays_equal_pytorchs_for_several_scenes_and_views() {
        let fixture = Fixture::open("rays");
        for device in devices() {
            let cameras = Cameras {
                height: 16,
                width: 24,
                c2w: fixture.tensor("input.c2w", &device),
                intrinsics: fixture.tensor("input.intrinsics", &device),
            };
            // f32 against f64: a few roundings of values up to 2.
            assert_close(&plucker(&cameras), &fixture.tensor::<5>("output.plucker", &device), 2e-6);
        }
    }

    fn one_camera(origin: [f32; 3], device: &Device) -> Cameras {
        let [x, y, z] = origin;
        let c2w = [1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, y, 0.0, 0.0, 1.0, z, 0.0, 0.0, 0.0, 1.0];
        Cameras::upload(&c2w, &[8.0, 8.0, 4.0, 4.0], [1, 1, 8, 8], device).expect("a valid camera")
    }

    #[test]
    fn directions_are_unit_and_moments_perpendicular_to_them() {
        for device in devices() {
            let rays = to_vec(plucker(&one_camera([0.3, -0.7, 0.2], &device)));
            for ray in rays.chunks(6) {
                let norm: f64 = ray[3..].iter().map(|v| v * v).sum();
                let dot: f64 = ray[..3].iter().zip(&ray[3..]).map(|(m, d)| m * d).sum();
                assert!((norm - 1.0).abs() < 1e-6 && dot.abs() < 1e-6, "{ray:?}");
            }
        }
    }

    #[test]
    fn plucker_is_unchanged_when_the_origin_slides_along_the_ray() {
        let device = Device::flex();
        let rays = to_vec(plucker(&one_camera([0.0; 3], &device)));
        let direction = &rays[3..6];
        // Sliding the camera along the ray of pixel (0, 0) leaves that pixel's coordinates alone.
        let origin = [0, 1, 2].map(|i| (direction[i] * 0.9) as f32);
        let slid = to_vec(plucker(&one_camera(origin, &device)));
        for (a, b) in rays[..6].iter().zip(&slid[..6]) {
            assert!((a - b).abs() < 1e-6, "{a} against {b}");
        }
    }

    #[test]
    fn the_optical_axis_passes_between_the_two_middle_pixels() {
        let device = Device::flex();
        let rays = to_vec(plucker(&one_camera([0.0; 3], &device)));
        let ray_of = |row: usize, column: usize| &rays[(row * 8 + column) * 6 + 3..][..3];
        assert!((ray_of(3, 3)[0] + ray_of(3, 4)[0]).abs() < 1e-7, "mirror images about the axis");
        assert!(ray_of(3, 3)[2] < 1.0, "no pixel's centre lies on it");
    }

    #[test]
    fn f64_cameras_give_f64_rays() {
        let device = Device::flex();
        let double = (&device, burn::tensor::DType::F64);
        let cameras = Cameras {
            height: 8,
            width: 8,
            c2w: Tensor::from_data(
                TensorData::from([[[
                    [1.0, 0.0, 0.0, 0.0],
                    [0.0, 1.0, 0.0, 0.0],
                    [0.0, 0.0, 1.0, 0.0],
                    [0.0, 0.0, 0.0, 1.0f64],
                ]]]),
                double,
            ),
            intrinsics: Tensor::from_data(TensorData::from([[[8.0, 8.0, 4.0, 4.0f64]]]), double),
        };
        assert_eq!(plucker(&cameras).dtype(), burn::tensor::DType::F64);
    }
}
