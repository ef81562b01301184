//! Unusable images and frames, with their reasons.

use std::fs;
use std::path::Path;

use clift_core::{Camera, DMat3, IntrinsicsNorm, Pose, RgbImage};
use clift_data::{FileOptions, OpenedSource, PosesFrom, encode_jpeg, encode_png};
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
fn unusable_images_are_skipped_at_opening() {
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
        ("turned.png", encode_png(&image(32, 48)).unwrap()),
        ("words.png", b"no image".to_vec()),
    ];
    let root = tempfile::tempdir().unwrap();
    write(root.path(), &images, &images.clone().map(|(name, _)| name));
    let OpenedSource { source, report, .. } = open_test(root.path()).unwrap();
    let mut skipped = ["1.jpg", "3.png", "8.jpg"].map(|name| (name, "whose image is truncated")).to_vec();
    skipped.push(("turned.png", "whose image has another aspect ratio than its camera"));
    skipped.push(("words.png", "whose image cannot be read"));
    assert_eq!(skipped_frames(&report), skipped);
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
    let images = [("0.png", encode_png(&image(48, 32)).unwrap()), ("1.png", vec![9])];
    let frames = [frame_at(0.0, "0.png"), frame_at(1.0, "1.png")];
    write_capture(root.path(), &images, &json!({"fl_x": 40, "h": 32, "frames": frames}));
    assert_eq!(skipped_frames(&open_test(root.path()).unwrap().report), [("1.png", "whose image cannot be read")]);
}

/// Returns a PNG with an EXIF orientation. Phones store sensor rows, with a tag for the rotation: 6 is a quarter turn
/// clockwise, 8 the other, 3 a half turn.
fn tagged(frame: &RgbImage, tag: u8) -> Vec<u8> {
    let png = encode_png(frame).unwrap();
    let exif = [&b"eXIfII*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0"[..], &[tag], &[0; 7]].concat();
    let sum = crc32fast::hash(&exif).to_be_bytes();
    [&png[..33], &(exif.len() as u32 - 4).to_be_bytes(), &exif, &sum, &png[33..]].concat()
}

#[test]
fn the_principal_point_tells_the_pixels_of_the_poses() {
    const UNDECIDED: &str = "data.files.poses_from";
    for (tag, [cx, cy], note, size, fx) in [
        (6, [24.5, 16.0], "turned with their cameras", [32, 48], 50.0),
        (6, [16.0, 24.5], "as the size of the cameras requires", [32, 48], 40.0),
        (8, [32.0, 48.0], "as the size of the cameras requires", [32, 48], 20.0),
        (6, [20.0, 20.0], UNDECIDED, [32, 48], 50.0),
        (3, [24.0, 16.0], UNDECIDED, [48, 32], 40.0),
    ] {
        let root = tempfile::tempdir().unwrap();
        let json = json!({"fl_x": 40, "fl_y": 50, "cx": cx, "cy": cy, "frames": [frame_at(0.0, "0.png")]});
        write_capture(root.path(), &[("0.png", tagged(&image(48, 32), tag))], &json);
        let OpenedSource { source, report, .. } = open_test(root.path()).unwrap();
        assert!(report.to_string().contains(note), "{cx} {cy}: {report}");
        assert_eq!(source.image_size(0, 0).unwrap(), size, "{cx} {cy}");
        let got = source.cameras(0).unwrap()[0].intrinsics.to_pixels(size[0], size[1]).fx;
        assert!((got - fx).abs() < 1e-12, "{cx} {cy}: {got}");
    }
}

#[test]
fn views_are_turned_upright_from_the_pixels_of_the_poses() {
    let (wide, tall, square) = ([48, 32], [32, 48], [40, 40]);
    // Stored size, tag, size of the camera, pixels of the poses: which are turned, the image alone or the view.
    for (stored, tag, camera, poses_from, turned, note) in [
        (wide, 6, Some(wide), PosesFrom::Stored, "view", "turned with their cameras"),
        (wide, 6, Some(tall), PosesFrom::Stored, "image", "as the size of the cameras requires"),
        (tall, 8, Some(tall), PosesFrom::Turned, "view", "turned with their cameras"),
        (wide, 3, Some(wide), PosesFrom::Stored, "view", "data.files.poses_from"),
        (wide, 3, Some(wide), PosesFrom::Turned, "image", "data.files.poses_from"),
        (square, 6, Some(square), PosesFrom::Stored, "view", "data.files.poses_from"),
        (square, 8, Some(square), PosesFrom::Turned, "image", "data.files.poses_from"),
        (wide, 6, None, PosesFrom::Stored, "view", "data.files.poses_from"),
        (wide, 6, None, PosesFrom::Turned, "image", "data.files.poses_from"),
        (wide, 2, Some(wide), PosesFrom::Stored, "none", ""),
    ] {
        let root = tempfile::tempdir().unwrap();
        let image = image(stored[0], stored[1]);
        let mut json = json!({"fl_x": 40, "fl_y": 50, "frames": [frame_at(0.0, "0.png"), frame_at(1.0, "1.png")]});
        for (key, side) in ["w", "h"].iter().zip(camera.into_iter().flatten()) {
            json[*key] = side.into();
        }
        write_capture(root.path(), &[("0.png", tagged(&image, tag)), ("1.png", tagged(&image, tag))], &json);
        let OpenedSource { source, report, .. } =
            open_with(root.path(), FileOptions { poses_from, ..FileOptions::default() }).unwrap();
        let case = format!("{stored:?} {tag} {camera:?} {poses_from:?}: {report}");
        let has_note = report.notes.iter().any(|got| got.starts_with("2 images") && got.contains(note));
        assert!(has_note || note.is_empty(), "{case}");
        let (got, [width, height]) = (source.frame(0, 0).unwrap(), stored);
        assert_eq!(source.image_size(0, 0).unwrap(), [got.width, got.height], "{case}");
        assert_eq!(source.encoded_frame(0, 0).unwrap().is_some(), turned == "none", "{case}");
        // Where a stored pixel is in the turned image.
        let place = |x: usize, y: usize| match tag {
            3 => [width - 1 - x, height - 1 - y],
            6 => [height - 1 - y, x],
            8 => [y, width - 1 - x],
            _ => [x, y],
        };
        let camera = source.cameras(0).unwrap()[0];
        let direction = |camera: Camera<IntrinsicsNorm>, size: [usize; 2], [x, y]: [usize; 2]| {
            let intrinsics = camera.intrinsics.to_pixels(size[0], size[1]);
            Camera { c2w: camera.c2w, intrinsics }.direction(x as f64 + 0.5, y as f64 + 0.5)
        };
        // The pixels of the poses: focal lengths of 40 and 50 pixels, OpenGL axes.
        let of_poses = if turned == "image" { [got.width, got.height] } else { stored };
        let c2w = Pose { rotation: DMat3::from_diagonal([1.0, -1.0, -1.0].into()), ..Pose::IDENTITY };
        let [w, h] = of_poses.map(|side| side as f64);
        let given = Camera { c2w, intrinsics: IntrinsicsNorm { fx: 40.0 / w, fy: 50.0 / h, cx: 0.5, cy: 0.5 } };
        for (x, y) in [(0, 0), (width - 1, 0), (0, height - 1), (20, 9)] {
            let [column, row] = place(x, y);
            let rgb = |image: &RgbImage, x: usize, y: usize| image.rgb[3 * (y * image.width + x)..][..3].to_vec();
            assert_eq!(rgb(&got, column, row), rgb(&image, x, y), "{case}");
            let expected = direction(given, of_poses, if turned == "image" { [column, row] } else { [x, y] });
            let ray = direction(camera, [got.width, got.height], [column, row]);
            assert!(ray.distance(expected) < 1e-12, "{case}: {ray} {expected}");
        }
    }
}

#[test]
fn one_bad_item_costs_one_frame() {
    let jpeg = |quality| encode_jpeg(&image(96, 64), quality).unwrap();
    let name = |frame: usize| format!("{frame}.jpg");
    let damaged = |bytes: &[u8], at: usize, value: &dyn Fn(usize) -> u8| {
        let mut bytes = bytes.to_vec();
        (at..at + 600).for_each(|at| bytes[at] = value(at));
        bytes
    };
    let camera = "whose camera cannot be used: ";
    for (what, json, damage, expected) in [
        ("fisheye", Some(("camera_model", json!("SPHERICAL"))), None, camera),
        ("-nan(ind)", Some(("cx", json!("-nan(ind)"))), None, "whose entry is malformed: number out of range"),
        (
            "1.#QNAN matrix",
            Some(("transform_matrix", json!([[1, 0, 0, "1.#QNAN"], [0, 1, 0, 0], [0, 0, 1, 0]]))),
            None,
            "whose entry is malformed: number out of range",
        ),
        ("no matrix", Some(("transform_matrix", json!(null))), None, camera),
        ("3 x 3 matrix", Some(("transform_matrix", json!([[1, 0, 0], [0, 1, 0], [0, 0, 1]]))), None, "whose entry is"),
        ("shear", Some(("transform_matrix", json!([[1, 0.5, 0, 3], [0, 1, 0, 0], [0, 0, 1, 0]]))), None, camera),
        ("number as mask", Some(("mask_path", json!(3))), None, "whose entry is malformed: invalid type: integer `3`"),
        ("lost mask", Some(("mask_path", json!("masks/none.png"))), None, "without the mask of its mask_path"),
        ("1e999", Some(("fl_x", json!("1e999"))), None, "whose entry is malformed: number out of range"),
        ("no name", Some(("file_path", json!(null))), None, "whose entry is malformed: invalid type: null"),
        ("no entry", Some(("", json!(null))), None, "whose entry is malformed: invalid type: null"),
        ("zeros", None, Some(damaged(&jpeg(90), 2500, &|_| 0)), "whose image is damaged"),
        ("noise", None, Some(damaged(&jpeg(90), 2500, &|at| (at * at / 7 % 251) as u8)), "whose image is damaged"),
        (
            "far",
            Some(("transform_matrix", json!([[1, 0, 0, 1e5], [0, 1, 0, 0], [0, 0, 1, 0]]))),
            None,
            "whose camera is farther",
        ),
    ] {
        let root = tempfile::tempdir().unwrap();
        let mut images: Vec<_> = (0..6).map(|frame| (name(frame), jpeg(90))).collect();
        images[3].1 = damage.unwrap_or_else(|| jpeg(90));
        let mut frames: Vec<Value> = (0..6).map(|frame| frame_at(frame as f64, &name(frame))).collect();
        if let Some((key, value)) = json {
            *(if key.is_empty() { &mut frames[3] } else { &mut frames[3][key] }) = value;
        }
        write_capture(root.path(), &images, &json!({"fl_x": 80, "cx": 48, "w": 96, "h": 64, "frames": frames}));
        // Programs write these words without quotes.
        let path = root.path().join("transforms.json");
        let mut text = fs::read_to_string(&path).unwrap();
        for word in ["NaN", "-nan(ind)", "1.#QNAN", "1e999"] {
            text = text.replace(&format!("\"{word}\""), word);
        }
        fs::write(&path, text).unwrap();
        let OpenedSource { source, report, .. } =
            open_test(root.path()).unwrap_or_else(|error| panic!("{what}: {error}"));
        let [(frame, reason)] = skipped_frames(&report)[..] else { panic!("{what}: {report}") };
        let name_of_frame = if what.starts_with("no ") && what != "no matrix" { "frames[3]" } else { "3.jpg" };
        assert!(frame == name_of_frame && reason.starts_with(expected), "{what}: {report}");
        assert_eq!(source.frame_names(0).unwrap(), [0, 1, 2, 4, 5].map(name), "{what}");
        assert!((0..5).all(|frame| source.frame(0, frame).is_ok()), "{what}");
    }
}

#[test]
fn one_bad_camera_of_a_colmap_model_costs_its_frame() {
    for (file, from, to, expected) in [
        ("cameras.txt", "7 PINHOLE", "9 THIN_PRISM 1 1 1\n8 PINHOLE 10 10 -nan(ind) 1 5 5\n7 PINHOLE", None),
        ("cameras.txt", "7 PINHOLE", "9 PINHOLE -1 1 1\n8 PINHOLE 9.0 9 1\n6 PINHOLE\n6\nx y\n7 PINHOLE", None),
        ("images.txt", "40 0.9833474432563557", "40 -nan(ind)", Some(("left/frame 8.png", "the pose holds NaN"))),
        ("images.txt", "7 left/frame 8.png", "x left/frame 8.png", Some(("left/frame 8.png", "CAMERA_ID is \"x\""))),
        ("images.txt", " 7 left/frame 8.png", "", Some(("line 5", "malformed: no CAMERA_ID"))),
        ("images.txt", "\n3.5 0 -1", "\n-nan(ind) 1.#IND -1 3.5 nan(ind) -1 7 zero -1 -nan(ind) 2 5", None),
        ("images.txt", "\n3.5 0 -1", "\n3 1 4 7.5 nan -1 7 3 5 -nan(ind) 2 5", None),
    ] {
        let root = copy_of_layout("colmap_txt");
        let path = root.path().join("attic/sparse/0").join(file);
        let text = fs::read_to_string(&path).unwrap();
        assert!(text.contains(from), "{from}");
        fs::write(&path, text.replacen(from, to, 1)).unwrap();
        let OpenedSource { source, report, .. } =
            open_test(root.path()).unwrap_or_else(|error| panic!("{to}: {error}"));
        let num_skipped = usize::from(expected.is_some());
        assert_eq!(source.num_frames(0).unwrap() + num_skipped, 6, "{to}: {report}");
        let skipped = skipped_frames(&report);
        assert_eq!(skipped.len(), num_skipped, "{to}: {report}");
        for ((frame, reason), (name, what)) in skipped.into_iter().zip(expected) {
            assert!(frame == name && reason.contains(what), "{to}: {report}");
        }
    }
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
