//! Fixtures, their copies, and captures.

use std::path::{Path, PathBuf};

use clift_core::RgbImage;
use clift_data::encode_png;
use serde_json::{Value, json};
use tempfile::TempDir;

pub fn fixtures() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../data-fixtures")
}

pub fn layout(name: &str) -> PathBuf {
    fixtures().join("layouts").join(name)
}

pub fn copy_of_layout(name: &str) -> TempDir {
    let root = tempfile::tempdir().unwrap();
    copy_folder(&layout(name), root.path());
    root
}

/// Returns a PNG with an aspect ratio of 3 : 2 whose pixels have one gray value.
pub fn gray(width: usize, value: usize) -> Vec<u8> {
    let height = width * 2 / 3;
    encode_png(&RgbImage { width, height, rgb: vec![value as u8; width * height * 3] }).unwrap()
}

/// Writes the image files and the `transforms.json` of a capture.
pub fn write_capture(root: &Path, images: &[(impl AsRef<Path>, Vec<u8>)], transforms: &Value) {
    for (name, bytes) in images {
        let path = root.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, bytes).unwrap();
    }
    std::fs::write(root.join("transforms.json"), transforms.to_string()).unwrap();
}

/// Returns a frame of a `transforms.json` whose camera is at `(x, 0, 0)`.
pub fn frame_at(x: f64, name: &str) -> Value {
    let c2w = json!([[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]);
    json!({"file_path": name, "transform_matrix": c2w})
}

pub fn copy_folder(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap() {
        let (path, target) = entry.map(|entry| (entry.path(), to.join(entry.file_name()))).unwrap();
        if path.is_dir() {
            copy_folder(&path, &target);
        } else {
            std::fs::copy(&path, &target).unwrap();
        }
    }
}
