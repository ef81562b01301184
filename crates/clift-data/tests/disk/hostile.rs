//! Broken and hostile scenes: errors with problem and path, in bounded time and memory.

use std::fs;
use std::path::Path;

use clift_data::OpenedSource;

use crate::files::copy_of_layout;
use crate::open_test;

/// Opens a data set and reads all scenes; returns the first error as text.
fn read(root: &Path) -> Result<usize, String> {
    let text = |error: clift_data::DataError| error.to_string();
    let source = open_test(root)?.source;
    for scene in 0..source.num_scenes() {
        for frame in 0..source.cameras(scene).map_err(text)?.len() {
            source.frame(scene, frame).map_err(text)?;
        }
    }
    Ok(source.num_scenes())
}

/// Reads a copy of a fixture in which `file` is changed.
fn changed(layout: &str, file: &str, change: impl FnOnce(Vec<u8>) -> Vec<u8>) -> Result<usize, String> {
    let root = copy_of_layout(layout);
    let path = root.path().join(file);
    fs::write(&path, change(fs::read(&path).unwrap())).unwrap();
    read(root.path())
}

/// Returns the error of reading a copy of a fixture in which a text is replaced, or the report of what was skipped.
fn replaced(layout: &str, file: &str, from: &str, to: &str) -> String {
    let root = copy_of_layout(layout);
    let path = root.path().join(file);
    let text = fs::read_to_string(&path).unwrap();
    assert!(text.contains(from), "{from}");
    fs::write(&path, text.replacen(from, to, 1)).unwrap();
    open_test(root.path()).map_or_else(|error| error, |opened| opened.report.to_string())
}

const JSON: &str = "attic/transforms.json";

#[test]
fn errors_of_transforms_json_are_named() {
    let long_name = format!("\"{}8\"", "a/".repeat(100_000));
    for (from, to, expected) in [
        (
            "\"./images/8\"",
            long_name.as_str(),
            "whose entry is malformed: its name has 200001 bytes, more than 4096 (a/a/",
        ),
        ("\"frames\"", "\"images\"", "missing field `frames`"),
        ("\"file_path\": \"./images/8\"", "\"file_path\": 8", "invalid type: integer `8`, expected a string"),
        ("\"fl_x\": 28.0", "\"fl_x\": -28.0", "fx is -0.875, expected a positive number"),
        ("\"fl_x\": 28.0", "\"fl_x\": NaN", "number out of range"),
        ("\"w\": 32", "\"w\": 0", "w is 0, expected a number of pixels"),
        ("\"OPENCV\"", "\"EQUIRECTANGULAR\"", "camera_model is EQUIRECTANGULAR, expected one of OPENCV, PINHOLE, "),
        (
            "\"fl_x\"",
            "\"distortion_params\": [0.1], \"fl_x\"",
            "distortion_params has 1 numbers, expected 4 or 6 for OPENCV",
        ),
        ("\"fl_x\"", "\"k1\": -9.5, \"fl_x\"", "cannot be undone at the edge of the image"),
        ("[[0.", "[[7.", "whose camera cannot be used: bad camera: the rotation is off an orthonormal one by"),
        ("[0.0, 0.0, 0.0, 1.0]", "[0.0, 0.0, 1.0, 1.0]", "transform_matrix ends in [0.0, 0.0, 1.0, 1.0]"),
        (
            "[0.0, 0.0, 0.0, 1.0]",
            "[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0]",
            "transform_matrix has 5 rows, expected 4",
        ),
    ] {
        let message = replaced("capture", JSON, from, to);
        assert!(message.contains(expected), "{to}: {message}");
        let is_of_one_frame = message.starts_with("1 scene used; ") && message.contains("; 1 frame whose ");
        assert!(
            is_of_one_frame || message.starts_with("bad scene: ") && message.ends_with("transforms.json"),
            "{message}"
        );
    }
    let without_focal_lengths = |bytes: Vec<u8>| {
        let text = String::from_utf8(bytes).unwrap();
        text.replace("\"fl_x\": 28.0, ", "").replace("\"fl_y\": 28.125, ", "").into_bytes()
    };
    let message = changed("capture", JSON, without_focal_lengths).unwrap_err();
    assert!(message.contains("expected fl_x or camera_angle_x, found neither"), "{message}");
    // A byte order mark in front is skipped.
    assert_eq!(changed("capture", JSON, |bytes| [b"\xef\xbb\xbf", &bytes[..]].concat()), Ok(1));
    let cut = changed("capture", JSON, |bytes| bytes[..bytes.len() / 2].to_vec()).unwrap_err();
    assert!(cut.contains("EOF while parsing"), "{cut}");
}

#[test]
fn uniform_scales_of_rotations_are_divided_out() {
    let cameras_equal = |layout: &str, root: &Path, note: &str| {
        let unchanged = open_test(copy_of_layout(layout).path()).unwrap().source.cameras(0).unwrap();
        let OpenedSource { source, report, .. } = open_test(root).unwrap();
        assert!(report.to_string().contains(note), "{report}");
        for (got, expected) in source.cameras(0).unwrap().iter().zip(&unchanged) {
            assert!(got.c2w.angle_to(expected.c2w) < 1e-7, "{got:?} {expected:?}");
            assert!(got.c2w.translation.distance(expected.c2w.translation) < 1e-7, "{got:?} {expected:?}");
        }
    };
    for scale in [0.25, 100.0] {
        let root = copy_of_layout("capture");
        let path = root.path().join(JSON);
        let mut json: serde_json::Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
        for frame in json["frames"].as_array_mut().unwrap().iter_mut().skip(1) {
            for entry in (0..3).flat_map(|row| (0..3).map(move |column| (row, column))) {
                let entry = &mut frame["transform_matrix"][entry.0][entry.1];
                *entry = (entry.as_f64().unwrap() * scale).into();
            }
        }
        fs::write(&path, json.to_string()).unwrap();
        cameras_equal("capture", root.path(), "frames with a scaled rotation in ");
        let root = copy_of_layout("re10k_txt");
        let scaled = |(column, word): (usize, &str)| match word.parse::<f64>() {
            Ok(number) if column >= 7 && column % 4 != 2 => (number * scale).to_string(),
            _ => word.to_owned(),
        };
        let line = |line: &str| line.split(' ').enumerate().map(scaled).collect::<Vec<_>>().join(" ");
        let path = root.path().join(RE10K);
        let text: Vec<String> = fs::read_to_string(&path).unwrap().lines().map(line).collect();
        fs::write(&path, text.join("\n")).unwrap();
        cameras_equal("re10k_txt", root.path(), "6 frames with a scaled rotation in ");
    }
}

const BINARY: [&str; 2] = ["attic/sparse/0/cameras.bin", "attic/sparse/0/images.bin"];
const RE10K: &str = "test/d6b00d693f813db59886beb214cc6e1939fe3d29fc1b4349616adf2d36ebdc6a.txt";
const TEXT: [&str; 2] = ["attic/sparse/0/cameras.txt", "attic/sparse/0/images.txt"];

/// Returns the error of reading a binary model with these bytes at a position of a file.
fn patched_model(file: &str, at: usize, patch: &[u8]) -> String {
    let change = |mut bytes: Vec<u8>| {
        bytes[at..at + patch.len()].copy_from_slice(patch);
        bytes
    };
    changed("colmap_bin", file, change).unwrap_err()
}

#[test]
fn truncated_or_huge_colmap_models_are_refused() {
    for file in BINARY {
        for count in [7, u64::from(u32::MAX), u64::MAX] {
            let message = patched_model(file, 0, &count.to_le_bytes());
            assert!(message.contains("exceeds the file of") && message.ends_with("s.bin"), "{message}");
        }
        for length in [0, 7, 9, 40, 100] {
            let message = changed("colmap_bin", file, |bytes| bytes[..length.min(bytes.len() - 1)].to_vec());
            assert!(message.unwrap_err().contains("the file is truncated"), "{file} of {length} bytes");
        }
    }
    // The number of points of the first image follows its name.
    let at = 8 + 4 + 56 + 4 + "left/frame 8.png".len() + 1;
    for count in [1 << 20, 1 << 60, u64::MAX / 24, u64::MAX] {
        let message = patched_model(BINARY[1], at, &count.to_le_bytes());
        assert!(message.contains("exceeds the file of"), "{count}: {message}");
    }
    let unending = |bytes: Vec<u8>| [&bytes[..8 + 64], &[b'x'; 10_000]].concat();
    assert!(changed("colmap_bin", BINARY[1], unending).unwrap_err().contains("is longer than 4096 bytes"));
}

#[test]
fn errors_of_colmap_models_are_named() {
    // OPENCV_FISHEYE, of id 5, has more parameters than the file.
    for (id, expected) in
        [(99, "camera 0 of 1 has the unknown model 99"), (-1, "unknown model -1"), (5_i32, "truncated")]
    {
        let message = patched_model(BINARY[0], 12, &id.to_le_bytes());
        assert!(message.contains(expected), "{message}");
    }
    for (file, from, to, expected) in [
        (0, "7 PINHOLE", "7 FULL_OPENCV", "camera 7: FULL_OPENCV has 4 parameters, expected 12"),
        (0, "7 PINHOLE", "7 FISH", "camera 7: the model is FISH, expected one of SIMPLE_PINHOLE, "),
        (0, "PINHOLE 32", "PINHOLE -32", "camera 7: line 4: WIDTH is \"-32\", expected a number"),
        (0, "PINHOLE 32 18", "PINHOLE 32 0", "camera 7: the size is 32x0 pixels"),
        (0, "32 18 28", "32 18 nan", "camera 7: bad camera: fx is NaN"),
        (0, "7 PINHOLE", "8 PINHOLE", "no camera 7"),
        (0, "7 PINHOLE", "7 PINHOLE\n7 PINHOLE", "camera 7: its id occurs twice"),
        (1, "40 0.9833474432563557", "40 nan", "the pose holds NaN"),
        (1, "40 0.98", "40 7.98", "the quaternion has length 7.98"),
        (1, "7 left/frame 8.png", "7", "the NAME has 0 bytes"),
        (1, "7 left/frame 8.png\n\n", "7 left/frame 8.png\n", "expected the points of the image above"),
    ] {
        let message = replaced("colmap_txt", TEXT[file], from, to);
        assert!(message.contains(expected), "{to}: {message}");
    }
    let long = |bytes: Vec<u8>| [b"x".repeat(1 << 20).as_slice(), b"\n", &bytes].concat();
    assert!(changed("colmap_txt", TEXT[0], long).unwrap_err().contains("line 1: the line is too long"));
}

#[test]
fn long_lines_of_points_are_skipped() {
    let change = |bytes: Vec<u8>| {
        let text = String::from_utf8(bytes).unwrap();
        text.replacen("\n3.5 0 -1", &format!("\n{}", "3.5 0.25 -1 ".repeat(200_000)), 1).into_bytes()
    };
    assert_eq!(changed("colmap_txt", TEXT[1], change), Ok(1));
}

#[test]
fn errors_of_re10k_text_name_the_line() {
    for (from, to, expected) in [
        ("\n1033367 0.875000000", "\n1033367", "line 3: expected 19 columns, got 18"),
        ("\n1033367 0.875000000", "\n1033367 0.875000000 7", "line 3: expected 19 columns, got more"),
        ("\n1033367 0.875000000", "\n1033367 NaN", "with frames whose camera cannot be used: bad camera: fx is NaN"),
        ("\n1033367 0.875000000", "\n1033367 wide", "with frames whose camera cannot be used: bad camera: fx is NaN"),
        (" 0.940808420 0.032698628", " 3 0.032698628", "the rotation is off an orthonormal one by"),
        ("\n1033367 ", "\n1033367.5 ", "line 3: the time stamp is \"1033367.5\""),
        ("\n1033367 ", "\n1000000 ", "line 3: the time stamp 1000000 does not exceed the previous one"),
    ] {
        let message = replaced("re10k_txt", RE10K, from, to);
        assert!(message.contains(expected), "{to}: {message}");
    }
}

#[test]
fn lists_of_millions_of_frames_are_refused() {
    let frame = r#"{"file_path":"a","transform_matrix":[]},"#;
    let change = |_| format!("{{\"frames\":[{}]}}", frame.repeat(200_000).trim_end_matches(',')).into_bytes();
    let message = changed("capture", JSON, change).unwrap_err();
    assert!(message.contains("a list of more than 100000 items"), "{message}");
    let deep = |_| format!("{{\"frames\":{}", "[".repeat(1 << 20)).into_bytes();
    assert!(changed("capture", JSON, deep).unwrap_err().starts_with("bad scene: "));
    let ignored = |_| format!("{{\"x\":{}", "[".repeat(1 << 20)).into_bytes();
    assert!(changed("capture", JSON, ignored).unwrap_err().contains("EOF while parsing"));
}

#[cfg(unix)]
#[test]
fn circular_links_and_devices_are_bounded() {
    use std::os::unix::fs::symlink;
    let root = copy_of_layout("capture");
    symlink(root.path(), root.path().join("up")).unwrap();
    symlink(root.path().join("attic"), root.path().join("again")).unwrap();
    symlink(root.path().join("loop"), root.path().join("loop")).unwrap();
    symlink("..", root.path().join("attic/images/up")).unwrap();
    assert_eq!(read(root.path()), Ok(1));
    // An image that is a device.
    symlink("/dev/zero", root.path().join("attic/images/99.png")).unwrap();
    let OpenedSource { source, report, .. } = open_test(root.path()).unwrap();
    assert_eq!(source.num_frames(0).unwrap(), 6);
    assert!(report.frames.iter().any(|skip| skip.reason == "whose image cannot be read"), "{report}");
    // Lists and chunks that are pipes, which would be read for ever.
    let root = copy_of_layout("scenes");
    let pipe = |name: &str| std::process::Command::new("mkfifo").arg(root.path().join(name)).status().unwrap();
    fs::write(root.path().join("test/index.json"), r#"{"a": "a.torch"}"#).unwrap();
    assert!(pipe("test/a.torch").success());
    let message = open_test(root.path()).err().unwrap();
    assert!(message.contains("bad chunk: a pipe or a device, which index.json lists"), "{message}");
    fs::remove_file(root.path().join("test/index.json")).unwrap();
    assert!(pipe("test/index.json").success());
    let message = open_test(root.path()).err().unwrap();
    assert!(message.contains("expected a regular file") && message.ends_with("index.json"), "{message}");
}
