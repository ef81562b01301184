//! Own captures: intrinsics, lenses, duplicate frames, model folders.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use clift_data::{
    FileOptions, IntrinsicsNorm, Lens, RgbImage, SceneSource, SkipReport, SourceOptions, Split, Undistortion,
    decode_image, encode_png,
};
use serde_json::{Value, json};

use crate::files::{copy_folder, fixtures};
use crate::open_at;

const SIZE: [usize; 2] = [24, 16];

/// Returns the PNG of an image that depends on a number.
fn png(number: u8) -> Vec<u8> {
    let [width, height] = SIZE;
    let rgb = (0..width * height * 3).map(|i| number.wrapping_mul(31).wrapping_add((i / 5) as u8)).collect();
    encode_png(&RgbImage { width, height, rgb }).unwrap()
}

/// Returns the rows of a camera-to-world matrix at `(x, 0, 0)`.
fn at(x: f64) -> Value {
    json!([[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
}

/// A capture with image files and a `transforms.json`.
struct Capture(tempfile::TempDir);

impl Capture {
    fn new(images: &[&str], transforms: &Value) -> Self {
        let root = tempfile::tempdir().unwrap();
        for (number, name) in images.iter().enumerate() {
            let path = root.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, png(number as u8)).unwrap();
        }
        fs::write(root.path().join("transforms.json"), transforms.to_string()).unwrap();
        Self(root)
    }

    fn open(&self) -> Result<(Arc<dyn SceneSource>, SkipReport), String> {
        let opened = open_at(self.0.path(), Split::Test, &SourceOptions::default());
        opened.map(|opened| (opened.source, opened.report)).map_err(|error| error.to_string())
    }
}

fn frame(name: &str, x: f64) -> Value {
    json!({"file_path": name, "transform_matrix": at(x)})
}

#[test]
fn angles_and_image_size_replace_missing_intrinsics() {
    let angle = 2.0 * (0.5_f64 / 0.8).atan();
    let capture = Capture::new(&["r_0.png"], &json!({"camera_angle_x": angle, "frames": [frame("./r_0", 0.0)]}));
    let k = capture.open().unwrap().0.cameras(0).unwrap()[0].intrinsics_norm;
    // Square pixels.
    for (got, expected) in [(k.fx, 0.8), (k.fy, 0.8 * 24.0 / 16.0), (k.cx, 0.5), (k.cy, 0.5)] {
        assert!((got - expected).abs() < 1e-12, "{k:?}");
    }
}

#[test]
fn frame_intrinsics_override_and_scale_with_images() {
    let mut own = frame("images/b.png", 1.0);
    for (key, value) in [("fl_x", 30.0), ("w", 48.0), ("h", 32.0), ("cx", 12.0)] {
        own[key] = value.into();
    }
    let top = json!({"fl_x": 120, "fl_y": 90, "cx": 60, "cy": 36, "w": 120, "h": 80,
                     "frames": [frame("images/a.png", 0.0), own]});
    let capture = Capture::new(&["images/a.png", "images/b.png"], &top);
    let cameras = capture.open().unwrap().0.cameras(0).unwrap();
    let [a, b] = [0, 1].map(|frame: usize| cameras[frame].intrinsics_norm);
    assert_eq!([a.fx, a.fy, a.cx, a.cy], [1.0, 1.125, 0.5, 0.45]);
    // The frame's fl_x holds for both axes and is not mixed with the fl_y of the top level.
    assert_eq!([b.fx, b.fy, b.cx, b.cy], [0.625, 0.9375, 0.25, 1.125]);
}

#[test]
fn images_named_twice_are_used_once() {
    let frames = [frame("images/a.png", 0.0), frame("images/a", 1.0), frame("images/b.png", 2.0)];
    let capture = Capture::new(&["images/a.png", "images/b.png"], &json!({"fl_x": 20, "frames": frames}));
    assert_eq!(capture.open().unwrap().0.num_frames(0).unwrap(), 2);
    let report = capture.open().unwrap().1;
    assert_eq!(report.frames[0].reason, "with the image of another frame");
    assert_eq!(report.frames.len(), 1);
}

/// Copies the COLMAP fixture with another camera model; returns its first image as stored.
fn colmap(model: &str) -> (tempfile::TempDir, RgbImage) {
    let root = tempfile::tempdir().unwrap();
    copy_folder(&fixtures().join("layouts/colmap_txt"), root.path());
    let path = root.path().join("attic/sparse/0/cameras.txt");
    let text = fs::read_to_string(&path).unwrap();
    let line = text.lines().find(|line| line.starts_with('7')).unwrap();
    fs::write(&path, text.replace(line, &format!("7 {model}"))).unwrap();
    let file = fs::read(root.path().join("attic/images/left/frame 8.png")).unwrap();
    (root, decode_image(&file, "", 0).unwrap())
}

fn open(root: &Path, undistort: Option<bool>) -> Arc<dyn SceneSource> {
    let files = FileOptions { undistort, ..FileOptions::default() };
    open_at(root, Split::Test, &SourceOptions { files, ..SourceOptions::default() }).unwrap().source
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
        assert_eq!(ignored.cameras(0).unwrap()[0].intrinsics_norm, norm, "{line}");
        assert_eq!(ignored.frame(0, 0).unwrap(), image, "{line}");
        let source = open(root.path(), None);
        if lens.is_pinhole() {
            assert_eq!(source.frame(0, 0).unwrap(), image, "{line}");
            continue;
        }
        let undistortion = Undistortion::new(norm, lens).unwrap();
        assert_eq!(source.cameras(0).unwrap()[0].intrinsics_norm, undistortion.intrinsics_norm(), "{line}");
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
    let report = open_at(root.path(), Split::Test, &SourceOptions::default()).unwrap().report;
    assert!(report.notes[0].ends_with("sparse/0 has 1 more models; only model 0 is used"), "{report}");
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
