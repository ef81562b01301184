//! Lens distortion against the camera models of COLMAP and the undistortion of OpenCV
//! (`scripts/fixtures/make_layout_fixtures.py`).

use clift_core::{IntrinsicsNorm, RgbImage};
use clift_data::{Lens, Undistortion};
use safetensors::SafeTensors;

use crate::files::fixtures;

const MODELS: [&str; 3] = ["SIMPLE_RADIAL", "RADIAL", "OPENCV"];

fn f64s(tensors: &SafeTensors<'_>, name: &str) -> Vec<f64> {
    tensors.tensor(name).unwrap().data().as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect()
}

/// Converts COLMAP parameters to intrinsics in pixels and a lens.
fn camera(model: &str, params: &[f64]) -> ([f64; 4], Lens) {
    let (pixels, [k1, k2, p1, p2]) = match (model, params) {
        ("SIMPLE_RADIAL", &[f, cx, cy, k]) => ([f, f, cx, cy], [k, 0.0, 0.0, 0.0]),
        ("RADIAL", &[f, cx, cy, k1, k2]) => ([f, f, cx, cy], [k1, k2, 0.0, 0.0]),
        (_, &[fx, fy, cx, cy, k1, k2, p1, p2]) => ([fx, fy, cx, cy], [k1, k2, p1, p2]),
        other => panic!("{other:?}"),
    };
    (pixels, Lens { radial: [k1, k2, 0.0], tangential: [p1, p2] })
}

#[test]
fn distorted_rays_equal_colmap() {
    let bytes = std::fs::read(fixtures().join("reference/lenses.safetensors")).unwrap();
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    for model in MODELS {
        let ([fx, fy, cx, cy], lens) = camera(model, &f64s(&tensors, &format!("{model}.params")));
        let (rays, pixels) = (f64s(&tensors, &format!("{model}.rays")), f64s(&tensors, &format!("{model}.pixels")));
        assert_eq!(rays.len(), 80);
        for (ray, pixel) in rays.as_chunks::<2>().0.iter().zip(pixels.as_chunks::<2>().0) {
            let [x, y] = lens.distort(*ray);
            let got = [x * fx + cx, y * fy + cy];
            assert!((got[0] - pixel[0]).abs() < 1e-9 && (got[1] - pixel[1]).abs() < 1e-9, "{model}: {got:?} {pixel:?}");
        }
    }
}

#[test]
fn undistorted_images_equal_opencv() {
    let bytes = std::fs::read(fixtures().join("reference/lenses.safetensors")).unwrap();
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    let image = RgbImage { width: 96, height: 72, rgb: tensors.tensor("picture").unwrap().data().to_vec() };
    for model in MODELS {
        let ([fx, fy, cx, cy], lens) = camera(model, &f64s(&tensors, &format!("{model}.params")));
        let from = IntrinsicsNorm { fx: fx / 96.0, fy: fy / 72.0, cx: cx / 96.0, cy: cy / 72.0 };
        let undistortion = Undistortion::new(from, lens).unwrap();
        let (to, zoom) = (undistortion.intrinsics_norm(), f64s(&tensors, &format!("{model}.zoom"))[0]);
        // OpenCV samples 2,001 points per edge, this crate 129.
        assert!((to.fx / from.fx / zoom - 1.0).abs() < 1e-5, "{model}: {} against {zoom}", to.fx / from.fx);
        assert!((to.fy / from.fy - to.fx / from.fx).abs() < 1e-15);
        assert_eq!((to.cx, to.cy), (from.cx, from.cy));
        let got = undistortion.apply(&image);
        assert_eq!((got.width, got.height), (96, 72));
        let expected = tensors.tensor(&format!("{model}.undistorted")).unwrap();
        let differences = got.rgb.iter().zip(expected.data()).map(|(a, b)| a.abs_diff(*b));
        let (worst, sum) = differences.fold((0, 0_u64), |(worst, sum), d| (worst.max(d), sum + u64::from(d)));
        let mean = sum as f64 / got.rgb.len() as f64;
        // OpenCV interpolates with 5 bits.
        assert!(worst <= 2 && mean < 0.1, "{model}: worst {worst}, mean {mean}");
        let unchanged = image.rgb.iter().zip(expected.data()).map(|(a, b)| u64::from(a.abs_diff(*b))).sum::<u64>();
        assert!(unchanged > 20 * sum.max(1), "{model}: the unchanged image would pass");
    }
}

#[test]
fn pinhole_lenses_change_nothing_and_invalid_ones_fail() {
    let norm = IntrinsicsNorm { fx: 0.8, fy: 1.1, cx: 0.45, cy: 0.52 };
    let pinhole = Undistortion::new(norm, Lens::default()).unwrap();
    for (got, expected) in [(pinhole.intrinsics_norm().fx, 0.8), (pinhole.intrinsics_norm().fy, 1.1)] {
        assert!((got - expected).abs() < 1e-12, "{got}");
    }
    let frame = RgbImage { width: 7, height: 5, rgb: (0..105).collect() };
    assert_eq!(pinhole.apply(&frame), frame);
    let message = |norm: IntrinsicsNorm, k1: f64| {
        let lens = Lens { radial: [k1, 0.0, 0.0], ..Lens::default() };
        Undistortion::new(norm, lens).unwrap_err().to_string()
    };
    assert!(message(norm, -2.0).contains("cannot be undone at the edge of the image"), "{}", message(norm, -2.0));
    assert!(message(IntrinsicsNorm { cx: 1.2, ..norm }, 0.01).contains("lies outside of the image"));
    assert!(message(norm, f64::INFINITY).contains("k1 is inf"));
}
