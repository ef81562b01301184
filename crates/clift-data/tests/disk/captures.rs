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
    for (line, fx, fy, radial, tangential) in [
        ("SIMPLE_PINHOLE 64 36 56 31 19", 56.0, 56.0, [0.0; 2], [0.0; 2]),
        ("PINHOLE 64 36 56 57 31 19", 56.0, 57.0, [0.0; 2], [0.0; 2]),
        ("SIMPLE_RADIAL 64 36 56 31 19 0.1", 56.0, 56.0, [0.1, 0.0], [0.0; 2]),
        ("RADIAL 64 36 56 31 19 0.1 -0.03", 56.0, 56.0, [0.1, -0.03], [0.0; 2]),
        ("OPENCV 64 36 56 57 31 19 0.1 -0.03 0.002 -0.001", 56.0, 57.0, [0.1, -0.03], [0.002, -0.001]),
    ] {
        let (root, image) = colmap(line);
        let (norm, lens) = (norm(fx, fy), Lens { radial: [radial[0], radial[1], 0.0], tangential });
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
