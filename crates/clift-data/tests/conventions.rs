//! Conversions between camera conventions and back.

use clift_core::{Camera, IntrinsicsNorm, Pose};
use glam::{DMat3, DQuat, DVec3};
use proptest::prelude::*;

/// Returns rotations of quaternions that are not near zero.
fn rotation() -> impl Strategy<Value = DMat3> {
    let quaternion = prop::array::uniform4(-1.0..1.0_f64).prop_map(DQuat::from_array);
    let long = quaternion.prop_filter("near zero", |quaternion| quaternion.length_squared() > 0.05);
    long.prop_map(|quaternion| DMat3::from_quat(quaternion.normalize()))
}

fn pose() -> impl Strategy<Value = Pose> {
    let centre = prop::array::uniform3(-50.0..50.0_f64).prop_map(DVec3::from);
    (rotation(), centre).prop_map(|(rotation, translation)| Pose { rotation, translation })
}

fn camera() -> impl Strategy<Value = Camera<IntrinsicsNorm>> {
    let intrinsics = [0.2..3.0_f64, 0.2..3.0_f64, 0.2..0.8_f64, 0.2..0.8_f64];
    (intrinsics, pose())
        .prop_map(|([fx, fy, cx, cy], c2w)| Camera { intrinsics: IntrinsicsNorm { fx, fy, cx, cy }, c2w })
}

fn rows(pose: Pose) -> [[f64; 4]; 3] {
    let matrix = pose.to_matrix_f64();
    [0, 1, 2].map(|i| [0, 1, 2, 3].map(|j| matrix[4 * i + j]))
}

fn worst(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

proptest! {
    #[test]
    fn cameras_round_trip_through_their_18_numbers(camera in camera()) {
        let row = camera.to_re10k();
        let back = Camera::from_re10k(row).unwrap();
        prop_assert!(worst(&back.c2w.to_matrix_f64(), &camera.c2w.to_matrix_f64()) < 1e-11); // centres are up to 87 away
        prop_assert_eq!(back.intrinsics, camera.intrinsics);
        prop_assert!(worst(&back.to_re10k(), &row) < 1e-11);
        prop_assert_eq!(&row[4..6], &[0.0, 0.0]);
        // The file holds w2c, which maps the camera centre to the origin.
        let centre = camera.c2w.translation;
        let seen = [0, 1, 2].map(|i| {
            let [a, b, c, d] = [0, 1, 2, 3].map(|j| row[6 + 4 * i + j]);
            a * centre[0] + b * centre[1] + c * centre[2] + d
        });
        prop_assert!(worst(&seen, &[0.0; 3]) < 1e-11);
    }

    #[test]
    fn opengl_axes_become_opencv_axes_and_back(pose in pose()) {
        let gl = rows(pose);
        let cv = Pose::from_opengl(&gl).unwrap();
        // The y and z axes change sign; the centre stays.
        prop_assert_eq!(cv.rotation.x_axis, pose.rotation.x_axis);
        prop_assert_eq!(cv.rotation.y_axis, -pose.rotation.y_axis);
        prop_assert_eq!(cv.rotation.z_axis, -pose.rotation.z_axis);
        prop_assert_eq!(cv.translation, pose.translation);
        prop_assert_eq!(Pose::from_opengl(&rows(cv)).unwrap(), pose);
    }

    #[test]
    fn inverse_poses_undo_poses(pose in pose(), x in -9.0..9.0_f64, y in -9.0..9.0_f64, z in -9.0..9.0_f64) {
        let point = DVec3::new(x, y, z);
        prop_assert!(pose.inverse().apply(pose.apply(point)).abs_diff_eq(point, 1e-11));
        prop_assert!(worst(&Pose::from_matrix(&pose.to_matrix_f64()).unwrap().to_matrix_f64(), &pose.to_matrix_f64()) == 0.0);
    }
}
