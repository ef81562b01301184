//! Lens distortion against the camera models of COLMAP and the undistortion of OpenCV
//! (`scripts/fixtures/make_layout_fixtures.py`).

use std::f64::consts::PI;

use clift_core::{IntrinsicsNorm, RgbImage};
use clift_data::{Lens, Undistortion};
use safetensors::SafeTensors;

use crate::files::fixtures;

/// COLMAP's models with a distorted lens that can be used, and their numbers of focal lengths.
const MODELS: [(&str, usize); 10] = [
    ("SIMPLE_RADIAL", 1),
    ("RADIAL", 1),
    ("OPENCV", 2),
    ("OPENCV_FISHEYE", 2),
    ("FULL_OPENCV", 2),
    ("SIMPLE_RADIAL_FISHEYE", 1),
    ("RADIAL_FISHEYE", 1),
    ("THIN_PRISM_FISHEYE", 2),
    ("SIMPLE_FISHEYE", 1),
    ("FISHEYE", 2),
];

fn f64s(tensors: &SafeTensors<'_>, name: &str) -> Vec<f64> {
    tensors.tensor(name).unwrap().data().as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect()
}

/// Returns intrinsics in pixels and the lens of a model of the fixture.
fn camera((model, num_focal): (&str, usize), tensors: &SafeTensors<'_>) -> ([f64; 4], Lens) {
    let params = f64s(tensors, &format!("{model}.params"));
    let lens = Lens::from_colmap(&model.to_lowercase(), &params[num_focal + 2..]).unwrap();
    ([params[0], params[num_focal - 1], params[num_focal], params[num_focal + 1]], lens)
}

#[test]
fn distorted_rays_equal_colmap() {
    let bytes = std::fs::read(fixtures().join("reference/lenses.safetensors")).unwrap();
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    let rays = f64s(&tensors, "rays");
    assert_eq!(rays.len(), 80);
    for model in MODELS {
        let ([fx, fy, cx, cy], lens) = camera(model, &tensors);
        let pixels = f64s(&tensors, &format!("{}.pixels", model.0));
        let mut moved: f64 = 0.0;
        for (ray, pixel) in rays.as_chunks::<2>().0.iter().zip(pixels.as_chunks::<2>().0) {
            let [x, y] = lens.distort(*ray);
            let got = [x * fx + cx, y * fy + cy];
            let back = lens.undistort([(pixel[0] - cx) / fx, (pixel[1] - cy) / fy]).unwrap();
            for axis in 0..2 {
                assert!((got[axis] - pixel[axis]).abs() < 1e-9, "{model:?}: {got:?} {pixel:?}");
                assert!((back[axis] - ray[axis]).abs() < 1e-9, "{model:?}: {back:?} {ray:?}");
            }
            moved = moved.max((x - ray[0]).hypot(y - ray[1]) * fx);
        }
        assert!(moved > 0.5, "{model:?}: a pinhole camera would pass");
    }
}

#[test]
fn undistorted_images_equal_opencv() {
    let bytes = std::fs::read(fixtures().join("reference/lenses.safetensors")).unwrap();
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    let image = RgbImage { width: 96, height: 72, rgb: tensors.tensor("picture").unwrap().data().to_vec() };
    for model in MODELS {
        let ([fx, fy, cx, cy], lens) = camera(model, &tensors);
        let from = IntrinsicsNorm { fx: fx / 96.0, fy: fy / 72.0, cx: cx / 96.0, cy: cy / 72.0 };
        let undistortion = Undistortion::new(from, lens).unwrap();
        let (to, zoom) = (undistortion.intrinsics_norm(), f64s(&tensors, &format!("{}.zoom", model.0))[0]);
        // The fixture samples 2,001 points per edge, this crate 129.
        assert!((to.fx / from.fx / zoom - 1.0).abs() < 1e-5, "{model:?}: {} against {zoom}", to.fx / from.fx);
        assert!((to.fy / from.fy - to.fx / from.fx).abs() < 1e-15);
        assert_eq!((to.cx, to.cy, undistortion.is_cut()), (from.cx, from.cy, false));
        let got = undistortion.apply(&image);
        assert_eq!((got.width, got.height), (96, 72));
        let expected = tensors.tensor(&format!("{}.undistorted", model.0)).unwrap();
        let differences = got.rgb.iter().zip(expected.data()).map(|(a, b)| a.abs_diff(*b));
        let (worst, sum) = differences.fold((0, 0_u64), |(worst, sum), d| (worst.max(d), sum + u64::from(d)));
        assert!(worst <= 1, "{model:?}: worst {worst}");
        let unchanged = image.rgb.iter().zip(expected.data()).map(|(a, b)| u64::from(a.abs_diff(*b))).sum::<u64>();
        assert!(unchanged > 20 * sum.max(1), "{model:?}: the unchanged image would pass");
    }
}

#[test]
fn views_that_no_pinhole_camera_holds_are_cut() {
    // Focal lengths of a 180 degree equidistant lens across the columns; image circles within and beyond the sensor;
    // a perspective lens that folds over in the corners.
    let fold = Lens { radial: [-0.32, 0.0, 0.0, 0.0], ..Lens::default() };
    let fisheye = |k1: f64| Lens::from_colmap("SIMPLE_RADIAL_FISHEYE", &[k1]).unwrap();
    for (fx, fy, lens) in [
        (1.0 / PI, 1.5 / PI, fisheye(0.0)),
        (0.5 / PI, 0.75 / PI, fisheye(-0.03)),
        (0.25, 0.375, fisheye(0.02)),
        (0.66, 0.99, fold),
    ] {
        let from = IntrinsicsNorm { fx, fy, cx: 0.5, cy: 0.48 };
        let undistortion = Undistortion::new(from, lens).unwrap();
        assert!(undistortion.is_cut(), "{lens:?}");
        let to = undistortion.intrinsics_norm();
        let widest = (to.cx.max(1.0 - to.cx) / to.fx).max(to.cy.max(1.0 - to.cy) / to.fy);
        assert!(widest < 3.0_f64.sqrt() + 1e-12 && widest > 0.7, "{lens:?}: {widest}");
        for step in 0..=100 {
            let share = f64::from(step) / 100.0;
            for (u, v) in [(0.0, share), (1.0, share), (share, 0.0), (share, 1.0)] {
                let ray = [(u - to.cx) / to.fx, (v - to.cy) / to.fy];
                let [x, y] = lens.distort(ray);
                let [back, _] = lens.undistort([x, y]).expect("a ray before the fold");
                assert!((back - ray[0]).abs() < 1e-9, "{lens:?}");
                let (u, v) = (x * fx + 0.5, y * fy + 0.48);
                assert!((-1e-5..1.0 + 1e-5).contains(&u) && (-1e-5..1.0 + 1e-5).contains(&v), "{lens:?}: {u} {v}");
            }
        }
    }
}

#[test]
fn pinhole_lenses_change_nothing_and_principal_points_lie_in_the_image() {
    let norm = IntrinsicsNorm { fx: 0.8, fy: 1.1, cx: 0.45, cy: 0.52 };
    let pinhole = Undistortion::new(norm, Lens::default()).unwrap();
    for (got, expected) in [(pinhole.intrinsics_norm().fx, 0.8), (pinhole.intrinsics_norm().fy, 1.1)] {
        assert!((got - expected).abs() < 1e-12, "{got}");
    }
    let frame = RgbImage { width: 7, height: 5, rgb: (0..105).collect() };
    assert_eq!(pinhole.apply(&frame), frame);
    let lens = Lens { radial: [0.01, 0.0, 0.0, 0.0], ..Lens::default() };
    let message = Undistortion::new(IntrinsicsNorm { cx: 1.2, ..norm }, lens).unwrap_err().to_string();
    assert!(message.contains("lies outside of the image"), "{message}");
}
