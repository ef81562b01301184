//! Unusable images and frames, with their reasons.

use std::fs;
use std::path::Path;

use clift_core::RgbImage;
use clift_data::{FileOptions, OpenedSource, decode_image, encode_jpeg, encode_png};
use serde_json::{Value, json};

use crate::files::{copy_of_layout, frame_at, write_capture};
use crate::{open_test, open_with, skipped_frames};

fn image(width: usize, height: usize) -> RgbImage {
    RgbImage { width, height, rgb: (0..width * height * 3).map(|i| (i * i / 7) as u8).collect() }
}

fn write(root: &Path, images: &[(&str, Vec<u8>)], frames: &[&str]) {
    let frames: Vec<Value> = frames.iter().enumerate().map(|(x, name)| frame_at(x as f64, name)).collect();
    write_capture(root, images, &json!({"fl_x": 40, "w": 48, "h": 32, "frames": frames}));
}

#[test]
fn truncated_images_are_skipped_at_opening() {
    let (jpeg, png) = (encode_jpeg(&image(48, 32), 90).unwrap(), encode_png(&image(48, 32)).unwrap());
    let cut = |bytes: &[u8]| bytes[..bytes.len() * 3 / 4].to_vec();
    let padded = |bytes: &[u8]| [bytes, &[0; 900]].concat();
    let appended = |bytes: &[u8]| [bytes, &b"\x01a film of the phone".repeat(99)].concat();
    let images = [
        ("0.jpg", jpeg.clone()),
        ("1.jpg", cut(&jpeg)),
        ("2.png", png.clone()),
        ("3.png", cut(&png)),
        ("4.jpg", padded(&jpeg)),
        ("5.png", padded(&png)),
        ("6.jpg", appended(&jpeg)),
        ("7.png", appended(&png)),
        ("8.jpg", padded(&cut(&jpeg))),
    ];
    let root = tempfile::tempdir().unwrap();
    write(root.path(), &images, &images.clone().map(|(name, _)| name));
    let OpenedSource { source, report, .. } = open_test(root.path()).unwrap();
    assert_eq!(skipped_frames(&report), ["1.jpg", "3.png", "8.jpg"].map(|name| (name, "whose image is truncated")));
    for frame in 0..source.num_frames(0).unwrap() {
        assert!(source.frame(0, frame).is_ok(), "{frame}");
    }
}

#[test]
fn scenes_without_usable_images_report_the_reason() {
    let jpeg = encode_jpeg(&image(48, 32), 90).unwrap();
    let turned = encode_jpeg(&image(32, 48), 90).unwrap();
    let scenes = tempfile::tempdir().unwrap();
    for (name, bytes, frames) in [
        ("corrupt", b"no image".to_vec(), &["0.jpg"][..]),
        ("cut", jpeg[..jpeg.len() / 2].to_vec(), &["0.jpg"]),
        ("empty", jpeg.clone(), &[]),
        ("heic", jpeg.clone(), &["0.heic", "1.jpg"]),
        ("missing", jpeg.clone(), &["1.jpg"]),
        ("turned", turned, &["0.jpg"]),
        ("whole", jpeg.clone(), &["0.jpg"]),
    ] {
        let file = if name == "heic" { "1.heic" } else { "0.jpg" };
        write(&scenes.path().join(name), &[(file, bytes)], frames);
    }
    let report = open_test(scenes.path()).unwrap().report;
    let reason = |key: &str| report.skips.iter().find(|skip| skip.key == key).unwrap().reason.as_str();
    assert!(reason("corrupt").contains("the image cannot be read"), "{report}");
    assert!(reason("cut").contains("the image is truncated"), "{report}");
    assert!(reason("empty").contains("no frames listed"), "{report}");
    assert!(reason("heic").contains("none of 2 frames is usable; 1.jpg is a frame whose image is neither"), "{report}");
    assert_eq!(reason("missing"), "without any image");
    assert!(reason("turned").contains("may have been rotated or cropped"), "{report}");
    assert_eq!(report.num_used(), 1);
    // DL3DV: only the first image of a scene is checked.
    let root = tempfile::tempdir().unwrap();
    for key in ["a", "b"].map(|digit| digit.repeat(64)) {
        write(&root.path().join(key), &[("0.jpg", jpeg.clone()), ("1.jpg", jpeg.clone())], &["0.jpg", "1.jpg"]);
    }
    fs::write(root.path().join("a".repeat(64)).join("0.jpg"), "no image").unwrap();
    let report = open_test(root.path()).unwrap().report;
    assert!(report.skips[0].reason.contains("the image cannot be read"), "{report}");
}

#[test]
fn unreadable_images_leave_other_frames_in_use() {
    let root = tempfile::tempdir().unwrap();
    write(root.path(), &[("0.png", encode_png(&image(48, 32)).unwrap()), ("1.png", vec![9])], &["0.png", "1.png"]);
    let path = root.path().join("transforms.json");
    let mut cameras: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    cameras.as_object_mut().unwrap().retain(|key, _| key != "w");
    fs::write(&path, cameras.to_string()).unwrap();
    assert_eq!(skipped_frames(&open_test(root.path()).unwrap().report), [("1.png", "whose image cannot be read")]);
}

#[test]
fn images_without_cameras_are_counted() {
    let png = || encode_png(&image(48, 32)).unwrap();
    let root = tempfile::tempdir().unwrap();
    let images = [("images/0.png", png()), ("images/1.png", png()), ("logo.png", png())];
    write(&root.path().join("a"), &images, &["images/0"]);
    let images = ["0", "1", "2"].map(|name| (format!("images/{name}.png"), png()));
    let images: Vec<(&str, Vec<u8>)> = images.iter().map(|(name, png)| (name.as_str(), png.clone())).collect();
    write(&root.path().join("b"), &images, &["images/2", "images/9"]);
    assert_eq!(open_test(root.path()).unwrap().report.notes[0], "3 images without a camera, not used: 1 of a, 2 of b");
    for (layout, frames) in [("colmap_bin/attic", "images/left"), ("re10k_folders", "")] {
        let copy = copy_of_layout(layout);
        let note = "1 image without a camera, not used: ";
        let has_note = || open_test(copy.path()).unwrap().report.notes.iter().any(|got| got.starts_with(note));
        assert!(!has_note(), "{layout}");
        let mut folder = copy.path().join(frames);
        if frames.is_empty() {
            let find = |path: &Path| walk(path).into_iter().find(|path| path.extension().is_some_and(|e| e == "png"));
            folder = find(copy.path()).unwrap().parent().unwrap().to_owned();
        }
        fs::write(folder.join("99.png"), png()).unwrap();
        assert!(has_note(), "{layout}");
    }
}

fn walk(folder: &Path) -> Vec<std::path::PathBuf> {
    let paths = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    paths.flat_map(|path| if path.is_dir() { walk(&path) } else { vec![path] }).collect()
}

#[test]
fn byte_order_marks_are_skipped() {
    let root = tempfile::tempdir().unwrap();
    write(root.path(), &[("0.png", encode_png(&image(48, 32)).unwrap())], &["0.png"]);
    let path = root.path().join("transforms.json");
    let text = fs::read(&path).unwrap();
    fs::write(&path, [b"\xef\xbb\xbf", &text[..]].concat()).unwrap();
    assert_eq!(open_test(root.path()).unwrap().source.num_frames(0).unwrap(), 1);
}

#[test]
fn images_are_found_by_the_end_of_paths() {
    let png = || encode_png(&image(48, 32)).unwrap();
    for (file, named, image_folder) in [
        ("images/0.png", ".\\images\\0.png", None),
        ("images/0.png", "./images\\0.png", None),
        ("images/left/0.png", "/home/somebody/cap/images/left/0.png", None),
        ("images/left/0.png", "C:\\Users\\somebody\\cap\\images\\left\\0.png", None),
        ("images/left_4/0.png", "/home/somebody/cap/images/left/0.png", None),
        ("0.png", "/home/somebody/cap/0.png", None),
        ("small/left/0.png", "/home/somebody/cap/images/left/0.png", Some("small")),
        ("small/0.png", "/home/somebody/cap/images/left/0.png", Some("small")),
        ("small/left/0.png", "images\\left\\0.png", Some("small")),
        ("images_4/0.png", "images/0.png", None),
        ("images/0.PNG", "./images/0.jpg", None),
        ("0.png", "0.png", None),
    ] {
        let root = tempfile::tempdir().unwrap();
        write(root.path(), &[(file, png())], &[named]);
        let files = FileOptions { image_folder: image_folder.map(str::to_owned), ..FileOptions::default() };
        let opened = open_with(root.path(), files).unwrap_or_else(|error| panic!("{file} for {named}: {error}"));
        assert_eq!(opened.source.num_frames(0).unwrap(), 1, "{file} for {named}");
    }
    // Relative paths keep their folder.
    let root = tempfile::tempdir().unwrap();
    write(root.path(), &[("0.png", png())], &["images/0.png"]);
    let message = open_test(root.path()).err().unwrap();
    assert!(message.contains("none of 1 frames has an image; the first is images/0.png"), "{message}");
}

#[test]
fn exif_orientation_follows_the_aspect_ratio_of_the_camera() {
    // Phones store sensor rows, with a tag for the rotation: 6 is a quarter turn clockwise.
    let tagged = |frame: &RgbImage| {
        let jpeg = encode_jpeg(frame, 90).unwrap();
        let exif = b"\xff\xe1\x00\x22Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0";
        [&jpeg[..2], exif, &jpeg[2..]].concat()
    };
    let root = tempfile::tempdir().unwrap();
    let (upright, lying) = (tagged(&image(48, 32)), tagged(&image(32, 48)));
    let images = [("0.jpg", upright.clone()), ("1.jpg", lying.clone()), ("2.jpg", tagged(&image(40, 40)))];
    write(root.path(), &images, &["0.jpg", "1.jpg", "2.jpg"]);
    let OpenedSource { source, report, .. } = open_test(root.path()).unwrap();
    assert_eq!(skipped_frames(&report), [("2.jpg", "whose image has another aspect ratio than its camera")]);
    let key = source.key(0);
    let notes = [
        format!("1 image turned by the EXIF orientation, as the size of the cameras requires: 1 of {key}"),
        format!(
            "1 image with an EXIF orientation that is not applied, as the cameras have the stored size: 1 of {key}"
        ),
    ];
    assert_eq!(report.notes[..2], notes);
    assert_eq!(source.frame(0, 0).unwrap(), decode_image(&upright, "0", 0).unwrap(), "as stored");
    let (turned, stored) = (source.frame(0, 1).unwrap(), decode_image(&lying, "1", 0).unwrap());
    assert_eq!((turned.width, turned.height, source.image_size(0, 1).unwrap()), (48, 32, [48, 32]));
    let pixel =
        |image: &RgbImage, column: usize, row: usize| image.rgb[3 * (row * image.width + column)..][..3].to_vec();
    for (column, row) in [(0, 0), (47, 0), (0, 31), (20, 9)] {
        assert_eq!(pixel(&turned, column, row), pixel(&stored, row, 47 - column), "{column} {row}");
    }
    assert_eq!(source.encoded_frame(0, 0).unwrap(), Some(upright));
    assert_eq!(source.encoded_frame(0, 1).unwrap(), None, "a copy of the file would lie on its side");
}

#[test]
fn photos_without_cameras_name_the_tools_for_poses() {
    let root = tempfile::tempdir().unwrap();
    for folder in ["images", "more"] {
        fs::create_dir(root.path().join(folder)).unwrap();
        fs::write(root.path().join(folder).join("IMG_1.JPG"), "").unwrap();
    }
    let message = open_test(root.path()).err().unwrap();
    for part in ["2 images without cameras", "colmap automatic_reconstructor", "ns-process-data images"] {
        assert!(message.contains(part), "{message}");
    }
    fs::remove_dir_all(root.path().join("images")).unwrap();
    fs::remove_dir_all(root.path().join("more")).unwrap();
    assert!(!open_test(root.path()).err().unwrap().contains("colmap"));
}
