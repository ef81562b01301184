//! Own captures: intrinsics, lenses, duplicate frames, model folders.

use std::fs;
use std::path::Path;
use std::sync::Arc;

use clift_core::{IntrinsicsNorm, RgbImage};
use clift_data::{
    FileOptions, Lens, OpenedSource, SceneSource, SourceOptions, Split, Undistortion, decode_image, encode_png,
    fit_image,
};
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::files::{copy_folder, copy_of_layout, frame_at, gray, write_capture};
use crate::{open_test, open_with, skipped_frames};

/// Opens a capture with images of 24 x 16 pixels and a `transforms.json`.
fn capture(images: &[&str], transforms: &Value) -> (TempDir, OpenedSource) {
    let images: Vec<_> = images.iter().map(|name| (*name, gray(24, 9))).collect();
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
        ("pinhole 64 36 56 57 31 19", 56.0, 57.0, 0),
        ("RADIAL 64 36 56 31 19 0.1 -0.03", 56.0, 56.0, 2),
        ("OPENCV 64 36 56 57 31 19 0.1 -0.03 0.002 -0.001", 56.0, 57.0, 4),
        ("FULL_OPENCV 64 36 56 57 31 19 0.1 -0.03 0.002 -0.001 0.01 0.05 0.01 0.02", 56.0, 57.0, 8),
    ] {
        let (root, image) = colmap(line);
        let words: Vec<&str> = line.split(' ').collect();
        let params: Vec<f64> = words[words.len() - num_distortion..].iter().map(|word| word.parse().unwrap()).collect();
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
    let polynomial = Lens { radial: [0.1, -0.02, 0.01, 1e-9], tangential: [0.002, 0.001], ..Lens::default() };
    for (keys, lens) in [
        (json!({"k1": 0.1, "k2": -0.02, "k3": 0.01, "k4": 1e-9, "p1": 0.002, "p2": 0.001}), polynomial),
        (json!({"camera_model": "opencv", "distortion_params": [0.1, -0.02, 0.01, 1e-9, 0.002, 0.001]}), polynomial),
        (json!({"is_fisheye": true, "k1": 0.05, "k2": 0.01}), colmap("RADIAL_FISHEYE", &[0.05, 0.01])),
        (
            json!({"camera_model": "OPENCV_FISHEYE", "k1": 0.05, "k4": 0.01}),
            colmap("OPENCV_FISHEYE", &[0.05, 0.0, 0.0, 0.01]),
        ),
        (json!({"camera_model": "simple_radial_fisheye", "k1": 0.05}), colmap("SIMPLE_RADIAL_FISHEYE", &[0.05])),
        (
            json!({"camera_model": "FULL_OPENCV", "k1": 0.1, "k4": 0.05, "k6": 0.01}),
            colmap("FULL_OPENCV", &[0.1, 0.0, 0.0, 0.0, 0.0, 0.05, 0.0, 0.01]),
        ),
        (
            json!({"camera_model": "THIN_PRISM_FISHEYE", "k1": 0.05, "p1": 0.002, "sx1": 0.01, "sy1": 0.003}),
            colmap("THIN_PRISM_FISHEYE", &[0.05, 0.0, 0.002, 0.0, 0.0, 0.0, 0.01, 0.003]),
        ),
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
    for (model, images) in [
        ("", "images"),
        ("colmap/sparse/0", "images"),
        ("dense/0/sparse", "dense/0/images"),
        ("distorted/sparse/0", "images"),
        ("sparse", "images_4"),
    ] {
        let other = tempfile::tempdir().unwrap();
        copy_folder(&scene.join("sparse/0"), &other.path().join("attic").join(model));
        copy_folder(&scene.join("images"), &other.path().join("attic").join(images));
        let source = open(other.path(), None);
        assert_eq!((source.key(0), source.frame(0, 0).unwrap()), ("attic", image.clone()), "{model}");
    }
}

/// Writes a COLMAP text model with images of 24 x 16 pixels at (0, 0, 0), (1, 0, 0), ..
fn write_model(folder: &Path, names: &[&str]) {
    fs::create_dir_all(folder).unwrap();
    fs::write(folder.join("cameras.txt"), "1 PINHOLE 24 16 20 20 12 8\n").unwrap();
    let line = |(x, name)| format!("{x} 1 0 0 0 -{x} 0 0 1 {name}\n\n");
    fs::write(folder.join("images.txt"), names.iter().enumerate().map(line).collect::<String>()).unwrap();
}

#[test]
fn the_colmap_model_with_most_images_is_used() {
    for (models, expected) in [
        (vec![("sparse/0", 3), ("sparse/1", 2), ("sparse/12", 7)], Some("of 3 models of ")),
        (
            vec![("sparse/0/models/0", 2), ("sparse/0/models/3", 5)],
            Some("sparse/0/models/3 with most images, 5, is used"),
        ),
        (vec![("sparse/a", 2), ("sparse/b", 8)], Some("sparse/b with most images, 8, is used")),
        (vec![("sparse", 4), ("sparse/0", 4)], Some("sparse with most images, 4, is used")),
        (vec![("sparse/1", 8)], None),
    ] {
        let root = tempfile::tempdir().unwrap();
        fs::create_dir(root.path().join("images")).unwrap();
        let names: Vec<String> = (0..8).map(|i| format!("{i}.png")).collect();
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        for name in &names {
            fs::write(root.path().join("images").join(name), gray(24, 9)).unwrap();
        }
        for (folder, count) in &models {
            write_model(&root.path().join(folder), &names[..*count]);
        }
        let OpenedSource { source, report, .. } = open_test(root.path()).unwrap();
        let most = models.iter().map(|(_, count)| *count).max().unwrap();
        assert_eq!(source.num_frames(0).unwrap(), most, "{models:?}");
        assert_eq!(report.notes.len(), usize::from(expected.is_some()), "{models:?}: {report}");
        assert!(expected.is_none_or(|note| report.notes[0].contains(note)), "{models:?}: {report}");
    }
}

#[test]
fn images_are_found_by_every_spelling_of_their_names() {
    // File, name in the camera file, configured folder; whether a COLMAP model may have the name as well.
    for (file, named, image_folder, is_of_colmap) in [
        ("images/a b/0.png", "images/a%20b/0.png", None, true),
        ("images/100%20.png", "images/100%20.png", None, true),
        ("images/k\u{fc}che.png", "images/ku\u{308}che.png", None, true),
        ("images/ku\u{308}che/0.png", "images/k\u{fc}che/0.png", None, true),
        ("images/left/0.png", "left\\0.png", None, true),
        ("images/left/0.png", "images\\left/0.png", None, true),
        ("images/left/0.png", "/home/somebody/images/left/0.png", None, true),
        ("images/left/0.png", "/home/somebody/photos/left/0.png", None, true),
        ("images/left/0.png", "C:\\Users\\somebody\\cap\\images\\left\\0.png", None, true),
        ("images/0.png", "D:/photos/left/0.png", None, true),
        ("images_4/left/0.png", "/home/somebody/photos/left/0.png", None, true),
        ("images_4/0.png", "images/0.png", None, true),
        ("images/0.PNG", "./images/0.jpg", None, false),
        ("0.png", "/home/somebody/cap/0.png", None, true),
        ("0.png", "0.png", None, true),
        ("small/left/0.png", "/home/somebody/cap/images/left/0.png", Some("small"), true),
        ("small/0.png", "/home/somebody/cap/images/left/0.png", Some("small"), true),
        ("small/left/0.png", "images\\left\\0.png", Some("small"), true),
    ] {
        let root = tempfile::tempdir().unwrap();
        let name = if named == "left\\0.png" { "images\\left\\0.png" } else { named };
        let transforms = json!({"fl_x": 20, "frames": [frame_at(0.0, name)]});
        write_capture(root.path(), &[(file, gray(24, 9))], &transforms);
        let files = FileOptions { image_folder: image_folder.map(str::to_owned), ..FileOptions::default() };
        let open =
            || open_with(root.path(), files.clone()).unwrap_or_else(|error| panic!("{file} as {named}: {error}"));
        assert_eq!(open().source.frame(0, 0).unwrap().rgb[0], 9, "{file} as {named}");
        if is_of_colmap {
            fs::remove_file(root.path().join("transforms.json")).unwrap();
            write_model(&root.path().join("sparse/0"), &[named]);
            assert_eq!(open().source.frame(0, 0).unwrap().rgb[0], 9, "{file} as {named}");
        }
    }
    #[cfg(target_os = "linux")]
    {
        use std::os::unix::ffi::OsStrExt;
        // A name in Latin-1, in the model and on disk or on one of them.
        let (latin, line) = (b"k\xfcche.png", b"0 1 0 0 0 0 0 0 1 k\xfcche.png\n\n");
        for file in [std::ffi::OsStr::from_bytes(latin), "k\u{fc}che.png".as_ref()] {
            let root = tempfile::tempdir().unwrap();
            write_model(&root.path().join("sparse/0"), &[]);
            fs::write(root.path().join("sparse/0/images.txt"), line).unwrap();
            fs::create_dir(root.path().join("images")).unwrap();
            fs::write(root.path().join("images").join(file), gray(24, 9)).unwrap();
            assert_eq!(open_test(root.path()).unwrap().source.frame_names(0).unwrap(), ["k\u{fc}che.png"]);
        }
    }
    // Relative paths keep their folder.
    let root = tempfile::tempdir().unwrap();
    let transforms = json!({"fl_x": 20, "frames": [frame_at(0.0, "images/0.png")]});
    write_capture(root.path(), &[("0.png", gray(24, 9))], &transforms);
    let message = open_test(root.path()).err().unwrap();
    assert!(message.contains("none of 1 frames has an image; the first is images/0.png"), "{message}");
}

#[test]
fn names_are_relative_to_the_folder_of_all_images() {
    for (files, expected) in [
        (["images/front/0.png", "images/back/0.png"], ["back/0.png", "front/0.png"]),
        (["images/0.png", "images/1.png"], ["0.png", "1.png"]),
        (["0.png", "left/0.png"], ["0.png", "left/0.png"]),
    ] {
        let frames: Vec<Value> = files.iter().zip([0.0, 1.0]).map(|(name, x)| frame_at(x, name)).collect();
        let (_root, opened) = capture(&files, &json!({"fl_x": 20, "frames": frames}));
        assert_eq!(opened.source.frame_names(0).unwrap(), expected);
    }
}

#[test]
fn dl3dv_frames_come_from_the_first_folder_that_is_large_enough() {
    for (folders, expected) in [
        (vec![("images_8", 48), ("images_4", 96)], Some(96)),
        (vec![("images_8", 96), ("images_4", 192)], Some(96)),
        (vec![("images_8", 24), ("images_4", 48)], None),
    ] {
        let root = tempfile::tempdir().unwrap();
        let (scene, empty) = (root.path().join("a".repeat(64)), root.path().join("b".repeat(64)));
        fs::create_dir_all(empty.join("images_8")).unwrap();
        let image = |(folder, width): &(&str, usize)| (format!("{folder}/0.png"), gray(*width, 9));
        let images: Vec<_> = folders.iter().map(image).collect();
        let transforms = json!({"fl_x": 300, "w": 384, "h": 256, "frames": [frame_at(0.0, "images/0.png")]});
        write_capture(&scene, &images, &transforms);
        let options = SourceOptions { min_size: [80, 50], ..SourceOptions::default() };
        let OpenedSource { source, report, .. } = crate::open(root.path(), Split::Test, &options).unwrap();
        let width = (source.num_scenes() > 0).then(|| source.image_size(0, 0).unwrap()[0]);
        assert_eq!(width, expected, "{folders:?}: {report}");
        let reason = report.skips.iter().find(|skip| skip.key == "b".repeat(64)).map(|skip| skip.reason.as_str());
        assert_eq!(reason, Some("without transforms.json"), "{report}");
    }
}

#[test]
fn calibrations_of_larger_images_are_guessed_from_the_principal_point() {
    for (given, width, note) in [
        (json!({"fl_x": 80, "cx": 48, "cy": 32}), 96.0, true),
        (json!({"fl_x": 80, "cx": 49.5, "cy": 31}), 96.0, true),
        (json!({"fl_x": 20, "cx": 12, "cy": 8}), 24.0, false),
        (json!({"fl_x": 20, "cx": 14, "cy": 8}), 24.0, false),
        (json!({"fl_x": 80}), 24.0, false),
        (json!({"fl_x": 80, "cx": 48, "cy": 32, "w": 24, "h": 16}), 24.0, false),
    ] {
        let mut transforms = given.clone();
        transforms["frames"] = json!([frame_at(0.0, "0.png"), frame_at(1.0, "1.png")]);
        let (_root, opened) = capture(&["0.png", "1.png"], &transforms);
        let fx = opened.source.cameras(0).unwrap()[0].intrinsics.fx;
        assert!((fx - given["fl_x"].as_f64().unwrap() / width).abs() < 1e-12, "{given}: {fx}");
        let has_note =
            opened.report.to_string().contains("the intrinsics are taken as those of images of 96x64; write w and h");
        assert_eq!(has_note, note, "{given}: {}", opened.report);
    }
}

#[test]
fn listed_frames_are_held_out() {
    let names = ["0.png", "1.png", "2.png", "3.png"];
    for (lists, held_out) in [
        (json!({"train_filenames": ["0.png", "3.png"], "test_filenames": ["1.png"]}), vec![1, 2]),
        (json!({"test_filenames": ["2.png"], "val_filenames": ["3.png"]}), vec![2, 3]),
        (json!({"train_filenames": ["./0.png", ".\\3.png"], "val_filenames": []}), vec![1, 2]),
        (json!({"train_filenames": ["lost.png"], "val_filenames": ["./2.png"]}), vec![2]),
        (json!({"test_filenames": [null, "lost.png", "3.png"]}), vec![3]),
        (json!({"train_filenames": ["lost.png"]}), vec![0, 2]),
        (json!({"test_filenames": []}), vec![0, 2]),
        (json!({}), vec![0, 2]),
    ] {
        let mut transforms = lists.clone();
        transforms["fl_x"] = 20.into();
        transforms["frames"] = names.iter().zip([0.0, 1.0, 2.0, 3.0]).map(|(name, x)| frame_at(x, name)).collect();
        let (_root, opened) = capture(&names, &transforms);
        assert_eq!(opened.source.held_out(0, 2).unwrap(), held_out, "{lists}");
        let has_note =
            opened.report.to_string().contains("1 name in the lists of file names without a frame (lost.png)");
        assert_eq!(has_note, lists.to_string().contains("lost"), "{}", opened.report);
        assert_eq!(opened.source.held_out(0, 0).unwrap(), [0; 0]);
        let training = opened.training_source(2);
        let kept: Vec<&str> = (0..4).filter(|frame| !held_out.contains(frame)).map(|frame| names[frame]).collect();
        assert_eq!(training.frame_names(0).unwrap(), kept, "{lists}");
        assert_eq!(training.cameras(0).unwrap()[1].c2w.translation[0], f64::from(kept[1].as_bytes()[0] - b'0'));
    }
}

#[test]
fn frames_of_real_estate_10k_are_matched_within_half_a_frame_or_in_order() {
    let camera = "0.9 1.6 0.5 0.5 0 0 1 0 0 0 0 1 0 0 0 0 1 0";
    let times = [1_000_000, 1_033_367, 1_066_733, 1_100_100];
    let all = |name: &dyn Fn(i64, usize) -> String| {
        times.iter().enumerate().map(|(i, time)| name(*time, i)).collect::<Vec<_>>()
    };
    for (names, is_found, note) in [
        (all(&|time, _| format!("{time}.png")), true, None),
        (
            all(&|time, i| format!("{}.png", if i == 2 { time + 100 } else { time })),
            true,
            Some("the names of 1 image differ"),
        ),
        (all(&|time, _| format!("{}.png", time - 16_000)), true, Some("the names of 4 images differ")),
        (all(&|_, i| format!("frame_{i:05}.png")), true, Some("in the order of their names")),
        (all(&|_, i| format!("{}.png", i + 9)), true, Some("in the order of their names")),
        (all(&|_, i| format!("frame_{i:05}.png"))[..3].to_vec(), false, None),
    ] {
        let root = tempfile::tempdir().unwrap();
        fs::create_dir_all(root.path().join("frames/clip")).unwrap();
        let lines = times.map(|time| format!("{time} {camera}\n")).concat();
        fs::write(root.path().join("clip.txt"), format!("https://example.org/clip\n{lines}")).unwrap();
        for (value, name) in names.iter().enumerate() {
            fs::write(root.path().join("frames/clip").join(name), gray(24, value)).unwrap();
        }
        let opened = open_test(root.path());
        if !is_found {
            let message = opened.err().unwrap();
            assert!(
                message.contains("name frames by time stamp") && message.contains("data.files.frames"),
                "{message}"
            );
            continue;
        }
        let OpenedSource { source, report, .. } = opened.unwrap();
        assert_eq!(report.notes.len(), usize::from(note.is_some()), "{report}");
        assert!(note.is_none_or(|note| report.notes[0].contains(note)), "{report}");
        let grays: Vec<u8> = (0..4).map(|frame| source.frame(0, frame).unwrap().rgb[0]).collect();
        assert_eq!(grays, [0, 1, 2, 3], "{names:?}");
    }
}

#[test]
fn large_photos_are_decoded_once_and_fit_to_the_same_pixels() {
    let root = tempfile::tempdir().unwrap();
    let (width, height) = (900, 600);
    let rgb = (0..width * height * 3).map(|i| (i % 251 + i / 9000) as u8).collect();
    let images = [("0.png", encode_png(&RgbImage { width, height, rgb }).unwrap()), ("1.png", gray(60, 9))];
    let frames = [frame_at(0.0, "0.png"), frame_at(1.0, "1.png")];
    write_capture(root.path(), &images, &json!({"fl_x": 800, "frames": frames}));
    let options = |caches_photos| SourceOptions { caches_photos, min_size: [32, 32], ..SourceOptions::default() };
    let open = |caches_photos| crate::open(root.path(), Split::Test, &options(caches_photos)).unwrap().source;
    let (plain, caching) = (open(false), open(true));
    let fitted = |source: &dyn SceneSource| {
        let frame = source.frame(0, 0).unwrap();
        fit_image(&frame, source.cameras(0).unwrap()[0].intrinsics, 32, 32).unwrap()
    };
    let (expected, small) = (fitted(plain.as_ref()), plain.frame(0, 1).unwrap());
    assert_eq!((fitted(caching.as_ref()), caching.frame(0, 1).unwrap()), (expected.clone(), small));
    for name in ["0.png", "1.png"] {
        fs::remove_file(root.path().join(name)).unwrap();
    }
    assert_eq!(fitted(caching.as_ref()), expected);
    assert!(plain.frame(0, 0).is_err() && caching.frame(0, 1).is_err());
}

#[test]
fn distortion_of_large_photos_is_removed_at_four_times_the_size() {
    let root = tempfile::tempdir().unwrap();
    let (width, height) = (900, 600);
    let wave = |x: usize, y: usize| (128.0 + 90.0 * (x as f64 / 60.0).sin() * (y as f64 / 50.0).cos()) as u8;
    let rgb = (0..width * height).flat_map(|i| [wave(i % width, i / width); 3]).collect();
    let images = [("0.png", encode_png(&RgbImage { width, height, rgb }).unwrap()), ("1.png", gray(60, 9))];
    let frames = [frame_at(0.0, "0.png"), frame_at(1.0, "1.png")];
    write_capture(root.path(), &images, &json!({"fl_x": 800, "k1": -0.2, "frames": frames}));
    let fitted = |min_size, undistort| {
        let files = FileOptions { undistort: Some(undistort), ..FileOptions::default() };
        let options = SourceOptions { min_size, files, ..SourceOptions::default() };
        let source = crate::open(root.path(), Split::Test, &options).unwrap().source;
        let frame = source.frame(0, 0).unwrap();
        let (fitted, camera) = fit_image(&frame, source.cameras(0).unwrap()[0].intrinsics, 32, 32).unwrap();
        (frame.width, fitted.rgb, camera)
    };
    let most = |a: &[u8], b: &[u8]| a.iter().zip(b).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
    let ((full, expected, camera), (reduced, got, same)) = (fitted([0; 2], true), fitted([32; 2], true));
    assert_eq!((full, reduced, camera), (900, 192, same));
    // One more resize rounds to whole levels.
    assert!(most(&got, &expected) <= 2, "{}", most(&got, &expected));
    assert!(most(&fitted([32; 2], false).1, &expected) > 8, "the distorted image would pass");
}

#[test]
fn hidden_files_are_ignored() {
    // A file that macOS writes beside a copied one.
    for (layout, hidden) in
        [("scenes", "test/._0.torch"), ("re10k_txt", "test/._0.txt"), ("capture", "attic/images/._8.png")]
    {
        let root = copy_of_layout(layout);
        fs::write(root.path().join(hidden), b"\0\x05\x16\x07\0\x02\0\0Mac OS X").unwrap();
        let opened = open_test(root.path()).unwrap();
        assert_eq!((opened.source.num_scenes(), opened.source.num_frames(0).unwrap()), (1, 6), "{layout}");
    }
}
