//! Coded scene files: round trips, sizes, and refused files.

use clift_core::{Camera, DMat3, DVec3, PoseNormalization};
use safetensors::SafeTensors;

use super::*;
use crate::codec::token_codec::tests::codec;
use crate::scene::scene::tests::{Folder, scene, scene_of_groups, with_header};

const STEP: f32 = 0.25;

/// Writes the model of the scene, as far as reading looks at it, and returns its codec.
fn write_model(folder: &Path) -> TokenCodec {
    let (folder, Scene { model, kind, renderer_hash, .. }) = (folder.join("runs/tiny"), scene());
    std::fs::create_dir_all(&folder).expect("a folder");
    std::fs::write(folder.join("model.safetensors"), "").expect("writes");
    std::fs::write(folder.join("config.toml"), "").expect("writes");
    let codec = codec(model, kind, renderer_hash);
    codec.write(&folder.join("codec.safetensors")).expect("writes");
    codec
}

/// A folder with a model's codec, whose model path is that of the scene, and the codec.
fn folder() -> (Folder, TokenCodec) {
    let folder = Folder::new();
    let codec = write_model(folder.0.path());
    (folder, codec)
}

fn write(folder: &Folder, codec: &TokenCodec, scene: &Scene) -> Vec<u8> {
    scene.write_coded(&folder.path(), codec, STEP).expect("writes");
    std::fs::read(folder.path()).expect("reads")
}

fn checked(mut bytes: Vec<u8>) -> Vec<u8> {
    let end = bytes.len() - 4;
    let checksum = crc32fast::hash(&bytes[..end]);
    bytes[end..].copy_from_slice(&checksum.to_le_bytes());
    bytes
}

/// The bytes with a value in the body, and a valid checksum.
fn with_body(bytes: &[u8], at: usize, value: &[u8]) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    let start = 8 + u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    bytes[start + at..][..value.len()].copy_from_slice(value);
    checked(bytes)
}

#[test]
fn coded_scenes_come_back_ordered_and_rounded() {
    let (folder, codec) = folder();
    let original = scene();
    let bytes = write(&folder, &codec, &original);
    assert_eq!(write(&folder, &codec, &original), bytes, "equal scenes are equal files");
    assert!(SafeTensors::deserialize(&bytes).is_ok(), "the header is readable by other programs");
    let (back, storage) = Scene::read(&folder.path()).expect("reads");
    assert!(matches!(storage, TokenCoding::Coded(_)), "{storage}");
    assert_eq!(back.token_ids, [0, 3, 7, 8, 11]);
    let dim = original.model.dim;
    let expected = original.rounded_tokens(&codec, STEP).unwrap();
    for (new, old) in [0, 2, 3, 4, 1].into_iter().enumerate() {
        assert_eq!(back.tokens[new * dim..][..dim], expected[old * dim..][..dim], "token {new}");
    }
    assert_eq!((&back.key, &back.model), (&original.key, &original.model));
    assert_same_views(&back, &original);
    // Another model is given, or none is found.
    let moved = folder.0.path().join("elsewhere");
    std::fs::rename(folder.0.path().join("runs"), &moved).unwrap();
    let message = Scene::read(&folder.path()).unwrap_err().to_string();
    assert!(message.contains("give the run it was encoded with (--model RUN)"), "{message}");
    assert_eq!(Scene::read_for(&folder.path(), Some(&moved.join("tiny"))).unwrap().0, back);
    // A codec of another model.
    std::fs::remove_file(folder.path()).unwrap();
    let other = Scene { renderer_hash: "f".repeat(64), ..original };
    let message = other.write_coded(&folder.path(), &codec, STEP).unwrap_err().to_string();
    assert!(message.contains("the codec is of another model") && !folder.path().exists(), "{message}");
}

#[test]
fn every_flipped_bit_and_every_cut_is_found() {
    let (folder, codec) = folder();
    let bytes = write(&folder, &codec, &scene());
    for at in 0..bytes.len() {
        let mut damaged = bytes.clone();
        damaged[at] ^= 1 << (at % 8);
        folder.assert_refused(&damaged, "");
        folder.assert_refused(&bytes[..at], "");
    }
    let mut damaged = bytes.clone();
    let last = damaged.len() - 6;
    damaged[last] ^= 1;
    folder.assert_refused(&damaged, "the file is damaged: checksum");
}

#[test]
fn hostile_files_with_valid_checksums_are_refused() {
    let (folder, codec) = folder();
    let bytes = write(&folder, &codec, &scene());
    let refused =
        |changes: &[(&str, &str)], expected| folder.assert_refused(&checked(with_header(&bytes, changes)), expected);
    for (from, to, expected) in [
        ("\"tokens\":\"5\"", "\"tokens\":\"13\"", "13 tokens, expected 1 to 12"),
        ("\"tokens\":\"5\"", "\"tokens\":\"x\"", "tokens \"x\", expected a number"),
        ("\"tokens\":\"5\"", "\"tokens\":\"4\"", "words are left"),
        ("2x16x24", "18446744073709551615x16x24", "views and coded tokens"),
        ("2x16x24", "0x16x24", "0 context cameras"),
        ("2x16x24", "7x16x24", "views and coded tokens"),
        ("2x16x24", "2x16x1048576", "expected at most 16384 a side"),
        ("2x16x24", "2x16", "views \"2x16\", expected number x height x width"),
        ("2x16x24", "2x16x-24", "views \"2x16x-24\", expected number x height x width"),
        (&codec.hash, "0123456789abcdef", "the scene was coded with the codec 0123456789abcdef"),
        ("\"codec\"", "\"coder\"", "no `codec` in the header"),
        ("\"scene\":{", "\"scenf\":{", "no tensor `scene`"),
    ] {
        refused(&[(from, to)], expected);
    }
    // Many tokens that a small file claims.
    refused(&[("2x16x24", "2x4096x4096"), ("\"tokens\":\"5\"", "\"tokens\":\"524288\"")], "expected at most");
    for (at, value, expected) in [
        (0, &f32::NAN.to_le_bytes()[..], "step NaN"),
        (4, &f32::NAN.to_le_bytes(), "mean pose: bad camera: the pose holds NaN"),
        (4 + 16, &f64::NAN.to_le_bytes(), "mean pose: bad camera: the pose holds NaN"),
        (4 + 40, &(-1.0_f64).to_le_bytes(), "pose scale -1"),
        (4 + 48, &3_u32.to_le_bytes(), "views and coded tokens"),
        (4 + 48 + 4, &(-1.0_f32).to_le_bytes(), "context camera 0: bad camera: fx is -1"),
        (4 + 48 + 4 + 16, &f32::NAN.to_le_bytes(), "context camera 0: bad camera: the pose holds NaN"),
    ] {
        folder.assert_refused(&with_body(&bytes, at, value), expected);
    }
}

/// `CLIFT_UPDATE=1` writes scene and codec again; then `scripts/check/decode_scene.py .. --write` must write the tokens.
#[test]
fn fixture_has_the_tokens_of_the_python_decoder() {
    let fixtures = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../data-fixtures/coded");
    if std::env::var_os("CLIFT_UPDATE").is_some() {
        let codec = write_model(&fixtures);
        let mut unusual = scene();
        unusual.tokens[10] = -1e3; // escapes
        unusual.write_coded(&fixtures.join("room.clift"), &codec, STEP).unwrap();
    }
    let (room, _) = Scene::read(&fixtures.join("room.clift")).unwrap();
    assert_eq!(room.token_ids, [0, 3, 7, 8, 11]);
    assert_same_views(&room, &scene());
    let expected = numbers(&std::fs::read(fixtures.join("tokens.f32")).unwrap(), f32::from_le_bytes);
    assert_eq!(room.tokens.len(), expected.len());
    for (got, expected) in room.tokens.iter().zip(&expected) {
        assert!((got - expected).abs() < 1e-2, "{got} against {expected}");
    }
    assert!(expected.iter().any(|value| *value < -900.0), "a value far beyond the tables");
}

#[test]
fn groups_come_back_with_their_frames_and_views_with_their_intrinsics() {
    let (folder, codec) = folder();
    let mut original = scene_of_groups();
    original.world.mean_c2w.translation.x = 4_321_987.125;
    let shared = write(&folder, &codec, &original).len();
    // A half turn about an axis, whose quaternion has no real part.
    original.context[1].c2w.rotation = DMat3::from_diagonal(DVec3::new(-1.0, 1.0, -1.0));
    original.context[1].intrinsics.fx += 2.5;
    let bytes = write(&folder, &codec, &original);
    let (back, _) = Scene::read(&folder.path()).unwrap();
    assert_same_views(&back, &original);
    assert_eq!(back.tokens_of_groups(), original.tokens_of_groups());
    for (got, expected) in back.groups.iter().zip(&original.groups) {
        assert_eq!((&got.views, got.frame.scale), (&expected.views, expected.frame.scale));
        let [got, expected] = [got, expected].map(|group| group.frame.mean_c2w.to_matrix_f64());
        assert!(got.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-6), "{got:?}");
    }
    assert_eq!(bytes.len(), shared + 2 * 16);
    let groups = 4 + 48 + 4 + 3 * 16 + 3 * 32;
    for (at, value, expected) in [
        (0, 0_u16, "0 groups of context views, expected 1 to 1024 with views"),
        (0, u16::MAX, "3 views and coded tokens"),
        (6, 3, "a group of context view 3, expected less than 3"),
    ] {
        folder.assert_refused(&with_body(&bytes, groups + at, &value.to_le_bytes()), expected);
    }
}

fn assert_same_views(got: &Scene, expected: &Scene) {
    assert_eq!(got.context_frames, expected.context_frames);
    assert_eq!(got.context.len(), expected.context.len());
    // The center may be far from the origin, in meters of a map: it is stored in f64.
    let exact = |world: &PoseNormalization| (world.mean_c2w.translation, world.scale);
    assert_eq!(exact(&got.world), exact(&expected.world));
    assert!(got.world.mean_c2w.rotation.abs_diff_eq(expected.world.mean_c2w.rotation, 1e-6), "{:?}", got.world);
    for (got, expected) in got.context.iter().zip(&expected.context) {
        let values = |camera: &Camera| [&camera.c2w.to_matrix_f64()[..], &camera.intrinsics.to_array()].concat();
        assert!(values(got).iter().zip(values(expected)).all(|(a, b)| (a - b).abs() < 1e-6), "{got:?}");
    }
}
