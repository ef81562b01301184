//! Cameras between conventions, there and back.

use clift_data::{Camera, IntrinsicsNorm, Pose};
use proptest::prelude::*;

/// A rotation from a quaternion that is not near zero.
fn rotation() -> impl Strategy<Value = [[f64; 3]; 3]> {
    let component = || -1.0..1.0_f64;
    let long = |q: &[f64; 4]| q.iter().map(|value| value * value).sum::<f64>() > 0.05;
    [component(), component(), component(), component()].prop_filter("near zero", long).prop_map(|q| {
        let length = q.iter().map(|value| value * value).sum::<f64>().sqrt();
        let [w, x, y, z] = q.map(|value| value / length);
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    })
}

fn pose() -> impl Strategy<Value = Pose> {
    let place = || -50.0..50.0_f64;
    (rotation(), [place(), place(), place()]).prop_map(|(rotation, translation)| Pose { rotation, translation })
}

fn camera() -> impl Strategy<Value = Camera> {
    let intrinsics = [0.2..3.0_f64, 0.2..3.0_f64, 0.2..0.8_f64, 0.2..0.8_f64];
    (intrinsics, pose())
        .prop_map(|([fx, fy, cx, cy], c2w)| Camera { intrinsics_norm: IntrinsicsNorm { fx, fy, cx, cy }, c2w })
}

fn rows(pose: Pose) -> [[f64; 4]; 3] {
    let (r, t) = (pose.rotation, pose.translation);
    [0, 1, 2].map(|i| [r[i][0], r[i][1], r[i][2], t[i]])
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
        prop_assert_eq!(back.intrinsics_norm, camera.intrinsics_norm);
        prop_assert!(worst(&back.to_re10k(), &row) < 1e-11);
        prop_assert_eq!(&row[4..6], &[0.0, 0.0]);
        // What the file holds is w2c: it sends the camera's centre to the origin.
        let centre = camera.c2w.translation;
        let seen = [0, 1, 2].map(|i| {
            let [a, b, c, d] = [0, 1, 2, 3].map(|j| row[6 + 4 * i + j]);
            a * centre[0] + b * centre[1] + c * centre[2] + d
        });
        prop_assert!(worst(&seen, &[0.0; 3]) < 1e-11);
    }

    #[test]
    fn cameras_survive_f32_files(camera in camera()) {
        let row = camera.to_re10k().map(|value| f64::from(value as f32));
        let back = Camera::from_re10k(row).unwrap();
        // Translations are up to 87, in steps of 2^-18.
        prop_assert!(worst(&back.c2w.to_matrix_f64(), &camera.c2w.to_matrix_f64()) < 5e-5);
    }

    #[test]
    fn opengl_axes_become_opencv_axes_and_back(pose in pose()) {
        let gl = rows(pose);
        let cv = Pose::from_opengl(&gl).unwrap();
        let column = |j: usize| [0, 1, 2].map(|i| gl[i][j]);
        // Right stays right; up becomes down; what was behind is ahead. The centre stays.
        prop_assert!(worst(&cv.rotate([1.0, 0.0, 0.0]), &column(0)) < 1e-15);
        prop_assert!(worst(&cv.rotate([0.0, -1.0, 0.0]), &column(1)) < 1e-15);
        prop_assert!(worst(&cv.rotate([0.0, 0.0, -1.0]), &column(2)) < 1e-15);
        prop_assert_eq!(cv.translation, pose.translation);
        prop_assert_eq!(Pose::from_opengl(&rows(cv)).unwrap(), pose);
    }

    #[test]
    fn a_pose_and_its_inverse_undo_each_other(pose in pose(), x in -9.0..9.0_f64, y in -9.0..9.0_f64, z in -9.0..9.0_f64) {
        let point = [x, y, z];
        prop_assert!(worst(&pose.inverse().apply(pose.apply(point)), &point) < 1e-11);
        prop_assert!(worst(&Pose::from_matrix(&pose.to_matrix_f64()).unwrap().to_matrix_f64(), &pose.to_matrix_f64()) == 0.0);
    }
}
