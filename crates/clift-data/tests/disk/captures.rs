//! Own captures: intrinsics, lenses, duplicate frames, model folders.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use clift_core::{IntrinsicsNorm, RgbImage};
use clift_data::{FileOptions, Lens, OpenedSource, SceneSource, Undistortion, decode_image, encode_png};
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::files::{copy_folder, copy_of_layout, frame_at, write_capture};
use crate::{open_test, open_with, skipped_frames};

/// Opens a capture with images of 24 x 16 pixels and a `transforms.json`.
fn capture(images: &[&str], transforms: &Value) -> (TempDir, OpenedSource) {
    let png = encode_png(&RgbImage { width: 24, height: 16, rgb: vec![9; 24 * 16 * 3] }).unwrap();
    let images: Vec<_> = images.iter().map(|name| (*name, png.clone())).collect();
    let root = tempfile::tempdir().unwrap();
    write_capture(root.path(), &images, transforms);
    let opened = open_test(root.path()).unwrap();
    (root, opened)
}

#[test]
fn angles_and_image_size_replace_missing_intrinsics() {
    let angle = 2.0 * (0.5_f64 / 0.8).atan();
    let (_root, opened) = capture(&["r_0.png"], &json!({"camera_angle_x": angle, "frames": [frame_at(0.0, "./r_0")]}));
    let k = opened.source.cameras(0).unwrap()[0].intrinsics;
    // Square pixels.
    for (got, expected) in [(k.fx, 0.8), (k.fy, 0.8 * 24.0 / 16.0), (k.cx, 0.5), (k.cy, 0.5)] {
        assert!((got - expected).abs() < 1e-12, "{k:?}");
    }
}

#[test]
fn frame_intrinsics_override_and_scale_with_images() {
    let mut own = frame_at(1.0, "images/b.png");
    for (key, value) in [("fl_x", 30.0), ("w", 48.0), ("h", 32.0), ("cx", 12.0)] {
        own[key] = value.into();
    }
    let top = json!({"fl_x": 120, "fl_y": 90, "cx": 60, "cy": 36, "w": 120, "h": 80,
                     "frames": [frame_at(0.0, "images/a.png"), own]});
    let (_root, opened) = capture(&["images/a.png", "images/b.png"], &top);
    let cameras = opened.source.cameras(0).unwrap();
    let [a, b] = [0, 1].map(|frame: usize| cameras[frame].intrinsics);
    assert_eq!([a.fx, a.fy, a.cx, a.cy], [1.0, 1.125, 0.5, 0.45]);
    // The frame's fl_x holds for both axes and is not mixed with the fl_y of the top level.
    assert_eq!([b.fx, b.fy, b.cx, b.cy], [0.625, 0.9375, 0.25, 1.125]);
}

#[test]
fn images_named_twice_are_used_once() {
    let frames = [frame_at(0.0, "images/a.png"), frame_at(1.0, "images/a"), frame_at(2.0, "images/b.png")];
    let (_root, opened) = capture(&["images/a.png", "images/b.png"], &json!({"fl_x": 20, "frames": frames}));
    assert_eq!(opened.source.num_frames(0).unwrap(), 2);
    let [(_, reason)] = skipped_frames(&opened.report)[..] else { panic!("{}", opened.report) };
    assert_eq!(reason, "with the image of another frame");
}

/// Copies the COLMAP fixture with another camera model; returns its first image as stored.
fn colmap(model: &str) -> (TempDir, RgbImage) {
    let root = copy_of_layout("colmap_txt");
    let path = root.path().join("attic/sparse/0/cameras.txt");
    let text = fs::read_to_string(&path).unwrap();
    let line = text.lines().find(|line| line.starts_with('7')).unwrap();
    fs::write(&path, text.replace(line, &format!("7 {model}"))).unwrap();
    let file = fs::read(root.path().join("attic/images/left/frame 8.png")).unwrap();
    (root, decode_image(&file, "", 0).unwrap())
}

fn open(root: &Path, undistort: Option<bool>) -> Arc<dyn SceneSource> {
    open_with(root, FileOptions { undistort, ..FileOptions::default() }).unwrap().source
}

#[test]
fn colmap_lenses_are_undistorted_unless_ignored() {
    // The camera has twice the size of the images.
    let norm = |fx: f64, fy: f64| IntrinsicsNorm { fx: fx / 64.0, fy: fy / 36.0, cx: 31.0 / 64.0, cy: 19.0 / 36.0 };
    for (line, fx, fy, num_distortion) in [
        ("SIMPLE_PINHOLE 64 36 56 31 19", 56.0, 56.0, 0),
        ("pinhole 64 36 56 57 31 19", 56.0, 57.0, 0),
        ("SIMPLE_RADIAL 64 36 56 31 19 0.1", 56.0, 56.0, 1),
        ("RADIAL 64 36 56 31 19 0.1 -0.03", 56.0, 56.0, 2),
        ("OPENCV 64 36 56 57 31 19 0.1 -0.03 0.002 -0.001", 56.0, 57.0, 4),
        ("OPENCV 64 36 56 57 31 19 0.1 -0.03", 56.0, 57.0, 2),
        ("FULL_OPENCV 64 36 56 57 31 19 0.1 -0.03 0.002 -0.001 0.01 0.05 0.01 0.02", 56.0, 57.0, 8),
    ] {
        let (root, image) = colmap(line);
        let words: Vec<&str> = line.split(' ').collect();
        let mut params: Vec<f64> =
            words[words.len() - num_distortion..].iter().map(|word| word.parse().unwrap()).collect();
        if (words[0], num_distortion) == ("OPENCV", 2) {
            params.extend([0.0; 2]);
        }
        let (norm, lens) = (norm(fx, fy), Lens::from_colmap(words[0], &params).unwrap());
        let ignored = open(root.path(), Some(false));
        assert_eq!(ignored.cameras(0).unwrap()[0].intrinsics, norm, "{line}");
        assert_eq!(ignored.frame(0, 0).unwrap(), image, "{line}");
        let source = open(root.path(), None);
        if lens.is_pinhole() {
            assert_eq!(source.frame(0, 0).unwrap(), image, "{line}");
            continue;
        }
        let undistortion = Undistortion::new(norm, lens).unwrap();
        assert_eq!(source.cameras(0).unwrap()[0].intrinsics, undistortion.intrinsics_norm(), "{line}");
        assert_eq!(source.frame(0, 0).unwrap(), undistortion.apply(&image), "{line}");
        assert_ne!(source.frame(0, 0).unwrap(), image, "{line}");
        assert_eq!(source.encoded_frame(0, 0).unwrap(), None, "no file holds the resampled image");
    }
}

#[test]
fn fisheye_images_are_cut_with_a_note_and_never_taken_for_pinhole_images() {
    // 180 degrees across 64 columns.
    let (root, image) = colmap("OPENCV_FISHEYE 64 36 20.4 20.4 31 19 0 0 0 0");
    let OpenedSource { source, report, .. } = open_test(root.path()).unwrap();
    assert_ne!(source.frame(0, 0).unwrap(), image);
    assert!(report.to_string().contains("cut to the part of the lens that a pinhole camera can show"), "{report}");
    let k = source.cameras(0).unwrap()[0].intrinsics;
    assert!((((1.0 - k.cx) / k.fx).atan().to_degrees() - 60.0).abs() < 1e-9, "{k:?}");
    let options = FileOptions { undistort: Some(false), ..FileOptions::default() };
    let message = open_with(root.path(), options).map(|_| ()).unwrap_err();
    assert!(message.contains("set data.files.undistort to true"), "{message}");
}

#[test]
fn lenses_of_transforms_json_are_those_of_nerfstudio() {
    let colmap = |model: &str, params: &[f64]| Lens::from_colmap(model, params).unwrap();
    let polynomial = Lens { radial: [0.1, -0.02, 0.01, 1e-9, 0.0, 0.0], tangential: [0.002, 0.001], ..Lens::default() };
    let aria = [0.01, 0.02, 0.0, 0.0, 0.0, 0.0, 0.001, 0.002, 0.0, 0.0, 0.0, 0.0];
    for (keys, lens) in [
        (json!({"k1": 0.1, "k2": -0.02, "k3": 0.01, "k4": 1e-9, "p1": 0.002, "p2": 0.001}), polynomial),
        (json!({"camera_model": "opencv", "distortion_params": [0.1, -0.02, 0.01, 1e-9, 0.002, 0.001]}), polynomial),
        (json!({"is_fisheye": true, "k1": 0.05, "k2": 0.01}), colmap("RADIAL_FISHEYE", &[0.05, 0.01])),
        (
            json!({"camera_model": "OPENCV_FISHEYE", "k1": 0.05, "k4": 0.01}),
            colmap("OPENCV_FISHEYE", &[0.05, 0.0, 0.0, 0.01]),
        ),
        (json!({"camera_model": "simple_radial_fisheye", "k1": 0.05}), colmap("SIMPLE_RADIAL_FISHEYE", &[0.05])),
        (json!({"camera_model": "FOV", "omega": 0.9}), colmap("FOV", &[0.9])),
        (
            json!({"camera_model": "FULL_OPENCV", "k1": 0.1, "k4": 0.05, "k6": 0.01}),
            colmap("FULL_OPENCV", &[0.1, 0.0, 0.0, 0.0, 0.0, 0.05, 0.0, 0.01]),
        ),
        (
            json!({"camera_model": "THIN_PRISM_FISHEYE", "k1": 0.05, "p1": 0.002, "sx1": 0.01, "sy1": 0.003}),
            colmap("THIN_PRISM_FISHEYE", &[0.05, 0.0, 0.002, 0.0, 0.0, 0.0, 0.01, 0.003]),
        ),
        (json!({"camera_model": "FISHEYE624", "distortion_params": aria}), colmap("RAD_TAN_THIN_PRISM_FISHEYE", &aria)),
    ] {
        let mut transforms = json!({"fl_x": 24, "w": 24, "h": 16, "frames": [frame_at(0.0, "r_0.png")]});
        transforms.as_object_mut().unwrap().extend(keys.as_object().unwrap().clone());
        let (_root, opened) = capture(&["r_0.png"], &transforms);
        let norm = IntrinsicsNorm { fx: 1.0, fy: 1.5, cx: 0.5, cy: 0.5 };
        let expected = Undistortion::new(norm, lens).unwrap().intrinsics_norm();
        assert_eq!(opened.source.cameras(0).unwrap()[0].intrinsics, expected, "{keys}");
    }
}

#[test]
fn colmap_images_are_found_from_any_model_folder() {
    let (root, image) = colmap("PINHOLE 64 36 56 57 31 19");
    let scene = root.path().join("attic");
    copy_folder(&scene.join("sparse/0"), &scene.join("sparse/1"));
    let report = open_test(root.path()).unwrap().report;
    assert!(report.notes[0].ends_with("sparse has 1 more model; only model 0 is used"), "{report}");
    let models: [(&str, PathBuf); 3] =
        [("colmap/sparse/0", "images".into()), ("dense/sparse", "dense/images".into()), ("sparse", "images_4".into())];
    for (model, images) in models {
        let other = tempfile::tempdir().unwrap();
        copy_folder(&scene.join("sparse/0"), &other.path().join("attic").join(model));
        copy_folder(&scene.join("images"), &other.path().join("attic").join(images));
        let source = open(other.path(), None);
        assert_eq!((source.key(0), source.frame(0, 0).unwrap()), ("attic", image.clone()), "{model}");
    }
}
