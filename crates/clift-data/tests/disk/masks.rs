//! Masks and alpha channels of captures.

use std::fs;

use clift_core::RgbImage;
use clift_data::{ClipOptions, ClipReader, OpenedSource, SourceOptions, Split, ViewIndices, encode_png};
use image::{ImageFormat, RgbaImage};
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::files::{copy_of_layout, frame_at, gray, write_capture};
use crate::{open, open_test, skipped_frames};

const SIZE: [usize; 2] = [24, 16];

/// Returns the PNG of a mask whose left half is black, and whose other pixels are `level`.
fn mask(level: u8) -> Vec<u8> {
    let row = [[0; 36], [level; 36]].concat();
    encode_png(&RgbImage { width: SIZE[0], height: SIZE[1], rgb: row.repeat(SIZE[1]) }).unwrap()
}

/// Writes files beside `images/{a,b,c}.png` and opens the capture.
fn capture(files: &[(&str, Vec<u8>)], keys: &Value) -> (TempDir, OpenedSource) {
    let root = tempfile::tempdir().unwrap();
    let mut images: Vec<_> = ["images/a.png", "images/b.png", "images/c.png"].map(|name| (name, gray(24, 200))).into();
    images.extend(files.iter().cloned());
    let mut frames = [0.0, 1.0, 2.0].map(|x| frame_at(x, ["images/a.png", "images/b.png", "images/c.png"][x as usize]));
    frames[0].as_object_mut().unwrap().extend(keys.as_object().unwrap().clone());
    let transforms = json!({"fl_x": 20, "w": SIZE[0], "h": SIZE[1], "frames": frames});
    write_capture(root.path(), &images, &transforms);
    let opened = open_test(root.path()).unwrap();
    (root, opened)
}

#[test]
fn masked_and_transparent_pixels_have_the_background_and_no_weight() {
    let mut transparent = RgbaImage::from_pixel(24, 16, image::Rgba([200, 200, 200, 255]));
    transparent.enumerate_pixels_mut().filter(|(x, _, _)| *x < 12).for_each(|(_, _, pixel)| pixel.0[3] = 0);
    let mut png = std::io::Cursor::new(Vec::new());
    transparent.write_to(&mut png, ImageFormat::Png).unwrap();
    let none = json!({});
    for (name, bytes, keys, note) in [
        ("matte/x.png", mask(255), json!({"mask_path": "./matte/x.png"}), "1 image with a mask, "),
        ("matte/x.png", mask(1), json!({"mask_path": "matte\\x.png"}), "1 image with a mask, "),
        ("masks/a.png", mask(255), none.clone(), "1 image with a mask, "),
        ("masks/a.png.png", mask(255), none.clone(), "1 image with a mask, "),
        ("images/a.png", png.into_inner(), none, "1 image with an alpha channel, "),
    ] {
        let (_root, opened) = capture(&[(name, bytes)], &keys);
        assert!(opened.report.to_string().contains(note), "{name}: {}", opened.report);
        let (image, coverage) = opened.source.frame_with_coverage(0, 0).unwrap();
        let coverage = coverage.expect("a coverage").rgb;
        for (i, (value, weight)) in image.rgb.iter().zip(&coverage).enumerate() {
            let expected = if i % 72 < 36 { (0, 0) } else { (200, 255) };
            assert_eq!((*value, *weight), expected, "{name}: {i}");
        }
        assert_eq!(opened.source.frame(0, 0).unwrap(), image, "{name}");
        assert_eq!(opened.source.encoded_frame(0, 0).unwrap(), None, "{name}: no file holds the composited image");
        assert_eq!(opened.source.frame_with_coverage(0, 1).unwrap().1, None, "{name}");
    }
}

#[test]
fn clips_have_weights_of_targets_where_a_target_has_a_mask() {
    let (root, opened) = capture(&[("masks/a.png", mask(255))], &json!({}));
    let options = ClipOptions { width: 16, height: 16, ..ClipOptions::default() };
    let reader = ClipReader { source: opened.source, options };
    let read = |context: &[usize], target: &[usize]| {
        reader.read(0, &ViewIndices { context: context.to_vec(), target: target.to_vec() }).unwrap()
    };
    assert_eq!(read(&[0, 1], &[2]).target_weights, None);
    let clip = read(&[1, 2], &[1, 0]);
    // Four columns are cropped on each side: eight of sixteen count.
    let expected = [vec![255; 256], [[0; 8], [255; 8]].concat().repeat(16)].concat();
    assert_eq!(clip.target_weights, Some(expected.clone()));
    let half = [vec![255; 64], [[0; 4], [255; 4]].concat().repeat(8)].concat();
    assert_eq!(clip.at_half_resolution().target_weights, Some(half));
    let white = SourceOptions { background: [255; 3], ..SourceOptions::default() };
    let opened = open(root.path(), Split::Test, &white).unwrap();
    assert_eq!(opened.source.frame(0, 0).unwrap().rgb[0], 255);
}

#[test]
fn masks_of_colmap_are_turned_with_the_lens_and_bad_ones_are_named() {
    let root = copy_of_layout("colmap_txt");
    let masks = root.path().join("attic/masks/left");
    fs::create_dir_all(&masks).unwrap();
    let black = |width: usize| encode_png(&RgbImage { width, height: 9, rgb: vec![0; width * 27] }).unwrap();
    fs::write(masks.join("frame 8.png.png"), black(16)).unwrap(); // of half the size
    fs::write(masks.join("frame 9.png"), black(40)).unwrap();
    fs::write(masks.join("frame 10.png"), "no image").unwrap();
    let opened = open_test(root.path()).unwrap();
    let skipped = ["frame 9.png", "frame 10.png"].map(|name| (name, "whose mask cannot be used"));
    assert_eq!(skipped_frames(&opened.report), skipped);
    assert_eq!(opened.source.num_frames(0).unwrap(), 4);
    assert!(opened.report.to_string().contains("1 image with a mask"), "{}", opened.report);
    let (image, coverage) = opened.source.frame_with_coverage(0, 0).unwrap();
    assert_eq!((image.rgb.iter().max(), coverage.unwrap().rgb.iter().max()), (Some(&0), Some(&0)));
    // After opening, the mask of a used frame is damaged.
    fs::write(masks.join("frame 8.png.png"), black(40)).unwrap();
    let message = opened.source.frame(0, 0).unwrap_err().to_string();
    assert!(message.contains("40x9 pixels, the image has 32x18") && message.ends_with("frame 8.png.png"), "{message}");
}
