//! Scene files: what survives them, how large they are, and what is refused.

use std::path::PathBuf;

use safetensors::SafeTensors;

use super::*;
use crate::error::ModelError;

const DIM: usize = 8;

fn model() -> ModelConfig {
    ModelConfig { dim: DIM, num_heads: 2, ..ModelConfig::default() }
}

fn camera(x: f64, angle: f64) -> ViewCamera {
    let (sin, cos) = angle.sin_cos();
    ViewCamera {
        c2w: [cos, 0.0, sin, x, 0.0, 1.0, 0.0, 0.1, -sin, 0.0, cos, -0.2, 0.0, 0.0, 0.0, 1.0],
        intrinsics: [20.0, 21.0, 12.0, 8.0],
    }
}

/// Two views of 24 x 16 pixels, six patches each, of which five tokens are kept.
fn scene() -> Scene {
    let token_ids = vec![0, 11, 3, 7, 8];
    Scene {
        key: "0123456789abcdef".into(),
        kind: TokenKind::Clift,
        model: model(),
        renderer_hash: "0123456789abcdef".repeat(4),
        model_path: "runs/tiny".into(),
        height: 16,
        width: 24,
        context: vec![camera(-1.0, 0.2), camera(1.0, -0.3)],
        context_frames: vec![3, 41],
        world: SceneNormalization { mean_c2w: camera(17.0, 1.0).c2w, scale: 0.1 + 0.2 },
        tokens: (0..token_ids.len() * DIM).map(|i| (i as f32 - 17.0) * 0.317).collect(),
        token_ids,
    }
}

struct Place(tempfile::TempDir);

impl Place {
    fn new() -> Self {
        Self(tempfile::tempdir().expect("a temporary folder"))
    }

    fn path(&self) -> PathBuf {
        self.0.path().join("room.clift")
    }

    /// The bytes of a file that is well.
    fn bytes(&self, storage: TokenFormat) -> Vec<u8> {
        scene().write(&self.path(), storage).expect("writes");
        std::fs::read(self.path()).expect("reads")
    }

    /// What is said of these bytes.
    fn refused(&self, bytes: &[u8]) -> String {
        std::fs::write(self.path(), bytes).expect("writes");
        let error = Scene::read(&self.path()).expect_err("a hostile file");
        std::fs::remove_file(self.path()).expect("removes");
        assert!(matches!(error, ModelError::SceneFile { .. }), "{error:?}");
        let message = error.to_string();
        assert!(message.starts_with("cannot use the scene: ") && message.ends_with("room.clift"), "{message}");
        message
    }

    /// What is said of a file whose header has `from` replaced by `to`.
    fn with_header(&self, from: &str, to: &str) -> String {
        let bytes = self.bytes(TokenFormat::F32);
        let header = String::from_utf8(bytes[8..8 + HEADER_BYTES].to_vec()).expect("text");
        assert!(header.contains(from), "{from} is not in {header}");
        let header = header.trim_end().replace(from, to);
        let mut changed = (header.len() as u64).to_le_bytes().to_vec();
        changed.extend(header.bytes());
        changed.extend(&bytes[8 + HEADER_BYTES..]);
        self.refused(&changed)
    }

    /// What is said of a file with bytes of one tensor replaced.
    fn with_tensor(&self, storage: TokenFormat, name: &str, at: usize, data: &[u8]) -> String {
        let mut bytes = self.bytes(storage);
        let file = SafeTensors::deserialize(&bytes).expect("valid");
        let start = file.tensor(name).expect("there").data().as_ptr() as usize - bytes.as_ptr() as usize;
        bytes[start + at..][..data.len()].copy_from_slice(data);
        self.refused(&bytes)
    }
}

#[test]
fn a_scene_survives_its_file_and_the_file_has_the_size_of_the_formula() {
    let place = Place::new();
    for storage in TokenFormat::ALL {
        let bytes = place.bytes(storage);
        let expected = 8 + 2048 + 136 + 164 * 2 + 5 * (28 + storage.bytes_per_token(DIM));
        assert_eq!((bytes.len(), scene().file_bytes(storage)), (expected, expected as u64), "{storage}");
        let (back, found) = Scene::read(&place.path()).expect("reads");
        assert_eq!(found, storage);
        let tokens = storage.round(&scene().tokens, DIM).expect("in range");
        assert_eq!(back, Scene { tokens, ..scene() });
        assert_eq!(place.bytes(storage), bytes, "equal scenes are equal files");
        if storage == TokenFormat::F32 {
            assert_eq!(back, scene(), "to the bit");
        }
    }
    assert_eq!(std::fs::read_dir(place.0.path()).expect("a folder").count(), 1, "no temporary file is left");
}

#[test]
fn any_safetensors_reader_finds_the_tokens_and_their_rays() {
    let bytes = Place::new().bytes(TokenFormat::F16);
    let file = SafeTensors::deserialize(&bytes).expect("valid safetensors");
    let shape = |name: &str| file.tensor(name).expect("there").shape().to_vec();
    assert_eq!((shape("tokens"), shape("token_rays")), (vec![5, DIM], vec![5, 6]));
    let rays = file.tensor("token_rays").expect("there").data();
    let first: Vec<f32> = rays[..24].as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
    // Token 0 stands on the first patch of the first view, whose centre is at (4, 4).
    let direction = camera(-1.0, 0.2).direction(4.0, 4.0);
    for (got, expected) in first[3..].iter().zip(direction) {
        assert!((f64::from(*got) - expected).abs() < 1e-7, "{first:?} against {direction:?}");
    }
}

#[test]
fn the_ray_of_a_token_goes_through_its_own_view_row_and_column() {
    // Token 3 stands on patch 7: view 1, row 0, column 1.
    let ray = scene().token_rays()[3];
    assert_eq!(ray.origin, [1.0, 0.1, -0.2]);
    assert_eq!(ray.direction, camera(1.0, -0.3).direction(12.0, 4.0));
}

#[test]
fn an_empty_a_short_and_a_cut_off_file_are_refused() {
    let place = Place::new();
    assert!(place.refused(b"").contains("it is cut off: it has 0 bytes; copy it again"));
    assert!(place.refused(&[9, 0, 0]).contains("it is cut off: it has 3 bytes"));
    let bytes = place.bytes(TokenFormat::Int8);
    for length in [8, 1000, 8 + HEADER_BYTES - 1, 8 + HEADER_BYTES, bytes.len() - 1] {
        let message = place.refused(&bytes[..length]);
        assert!(message.contains("it is cut off") && message.contains("copy it again"), "{length}: {message}");
    }
}

#[test]
fn bytes_after_the_last_tensor_are_refused() {
    let place = Place::new();
    let bytes = [place.bytes(TokenFormat::F32), vec![0]].concat();
    assert!(place.refused(&bytes).contains("goes on after its last tensor"));
}

#[test]
fn a_header_of_hostile_length_is_refused_before_it_is_read() {
    let place = Place::new();
    let bytes = place.bytes(TokenFormat::F32);
    for length in [u64::MAX, 1 << 63, 100_000_000, (1 << 16) + 1] {
        let message = place.refused(&[&length.to_le_bytes()[..], &bytes[8..]].concat());
        assert!(message.contains(&format!("its header would have {length} bytes, more than 65536")), "{message}");
    }
}

#[test]
fn a_file_larger_than_any_scene_is_refused_unread() {
    let place = Place::new();
    let file = std::fs::File::create(place.path()).expect("creates");
    file.set_len((1 << 30) + 1).expect("a hole takes no space");
    let message = Scene::read(&place.path()).unwrap_err().to_string();
    assert!(message.contains("it has 1073741825 bytes, more than the 1073741824"), "{message}");
}

#[test]
fn what_is_no_scene_is_refused_with_what_to_give() {
    let place = Place::new();
    let message = place.refused(b"\x89PNG\r\n\x1a\n and so on");
    assert!(message.contains("give a file that `clift encode` wrote"), "{message}");
    let message = place.with_header("\"format\":\"clift-scene\"", "\"format\":\"clift-1\"");
    assert!(message.contains("its header does not say that it is a scene; give a file"), "{message}");
    let message = place.with_header("{\"__metadata__\"", "{\"__metadata__");
    assert!(message.contains("its header cannot be read"), "{message}");
    let missing = place.0.path().join("no.clift");
    let message = Scene::read(&missing).unwrap_err().to_string();
    assert!(message.contains("No such file") && message.ends_with("no.clift"), "{message}");
}

#[test]
fn another_version_is_refused_with_both() {
    let message = Place::new().with_header("\"version\":\"2\"", "\"version\":\"1\"");
    assert!(
        message.contains("it has version \"1\", this program reads 2; use the version of clift that wrote it"),
        "{message}"
    );
}

#[test]
fn a_header_without_a_field_or_with_an_unknown_value_names_it() {
    let place = Place::new();
    for field in ["kind", "model", "renderer", "key", "height", "model_path"] {
        let message = place.with_header(&format!("\"{field}\":"), &format!("\"not_{field}\":"));
        assert!(message.contains(&format!("its header has no `{field}`; encode the scene again")), "{message}");
    }
    assert!(place.with_header("\"kind\":\"clift\"", "\"kind\":\"nerf\"").contains("unknown kind, Some(\"nerf\")"));
    assert!(place.with_header("\"width\":\"24\"", "\"width\":\"-24\"").contains("its width is \"-24\""));
    assert!(place.with_header("\"renderer\":\"0123", "\"renderer\":\"zz23").contains("not 64 hexadecimal digits"));
}

#[test]
fn a_model_with_unknown_or_impossible_sizes_is_refused() {
    let place = Place::new();
    let message = place.with_header("num_heads\\\":2", "num_heads\\\":3");
    assert!(message.contains("`model.num_heads` = 3: write a divisor of model.dim = 8"), "{message}");
    assert!(place.with_header("num_heads", "num_hands").contains("its model cannot be read (unknown field"));
    let message = place.with_header("\\\"dim\\\":8", "\\\"dim\\\":99999999999");
    assert!(message.contains("`tokens` is F32 [5, 8], expected F32 [5, 99999999999]"), "{message}");
}

#[test]
fn a_tensor_that_is_missing_more_or_of_another_type_or_shape_is_named() {
    let place = Place::new();
    assert!(place.with_header("\"token_ids\"", "\"token_idz\"").contains("it has no tensor `token_ids`"));
    let message = place.with_header("\"dtype\":\"F64\",\"shape\":[2, 4]", "\"dtype\":\"F32\",\"shape\":[4, 4]");
    assert!(message.contains("`context_intrinsics` is F32 [4, 4], expected F64 [2, 4]"), "{message}");
    let message = place.with_header("\"dtype\":\"F32\",\"shape\":[5, 8]", "\"dtype\":\"F32\",\"shape\":[8, 5]");
    assert!(message.contains("`tokens` is F32 [8, 5], expected F32 [5, 8]"), "{message}");
    let message = place.with_header("\"dtype\":\"F32\",\"shape\":[5, 8]", "\"dtype\":\"I32\",\"shape\":[5, 8]");
    assert!(message.contains("its tokens are I32, expected F32, F16 or I8"), "{message}");
    let message = place.with_header("\"dtype\":\"U32\",\"shape\":[5]", "\"dtype\":\"U32\",\"shape\":[5, 1]");
    assert!(message.contains("`token_ids` has the shape [5, 1], expected a list"), "{message}");
    let extra = "\"tokens\":{\"dtype\":\"F32\",\"shape\":[0],\"data_offsets\":[0,0]},\"more\":";
    assert!(place.with_header("\"tokens\":", extra).contains("cannot use the scene"));
}

#[test]
fn offsets_that_overlap_overflow_or_leave_the_file_are_refused() {
    let place = Place::new();
    for (from, to) in [
        ("\"data_offsets\":[0,256]", "\"data_offsets\":[8,264]"),
        ("\"data_offsets\":[0,256]", "\"data_offsets\":[256,0]"),
        ("\"data_offsets\":[0,256]", "\"data_offsets\":[0,18446744073709551615]"),
        ("\"shape\":[2, 4, 4]", "\"shape\":[4294967296, 4294967296, 4]"),
    ] {
        let message = place.with_header(from, to);
        assert!(message.contains("its header cannot be read"), "{message}");
    }
}

#[test]
fn values_that_are_not_finite_are_refused_wherever_they_are() {
    let place = Place::new();
    let (f32_nan, f64_nan) = (f32::NAN.to_le_bytes(), f64::NAN.to_le_bytes());
    let f32 = TokenFormat::F32;
    assert!(place.with_tensor(f32, "tokens", 4 * 17, &f32_nan).contains("token 2 holds NaN"));
    let infinity = half::f16::INFINITY.to_le_bytes();
    assert!(place.with_tensor(TokenFormat::F16, "tokens", 2 * 8, &infinity).contains("token 1 holds inf"));
    assert!(place.with_tensor(TokenFormat::Int8, "token_scales", 4, &f32_nan).contains("token 1 has the scale NaN"));
    let negative = (-1.0_f32).to_le_bytes();
    assert!(place.with_tensor(TokenFormat::Int8, "token_scales", 0, &negative).contains("token 0 has the scale -1"));
    assert!(place.with_tensor(f32, "token_rays", 24 + 8, &f32_nan).contains("the ray of token 1 is"));
    assert!(place.with_tensor(f32, "context_c2w", 8 * 16, &f64_nan).contains("context camera 1 holds NaN"));
    assert!(place.with_tensor(f32, "context_intrinsics", 0, &f64_nan).contains("context camera 0 has the intrinsics"));
    assert!(place.with_tensor(f32, "world_mean_c2w", 8, &f64_nan).contains("the mean pose holds NaN"));
    assert!(place.with_tensor(f32, "world_scale", 0, &f64_nan).contains("the scale of its poses is NaN"));
}

#[test]
fn a_scale_whose_tokens_overflow_is_refused() {
    let message = Place::new().with_tensor(TokenFormat::Int8, "token_scales", 0, &f32::MAX.to_le_bytes());
    assert!(message.contains("token 0 holds -inf"), "{message}");
}

#[test]
fn only_scenes_are_written_over() {
    let place = Place::new();
    let refusal = |path: &std::path::Path| scene().write(path, TokenFormat::F16).unwrap_err().to_string();
    scene().write(&place.path(), TokenFormat::F32).unwrap();
    scene().write(&place.path(), TokenFormat::F16).unwrap();
    // A scene that was cut off may be made again.
    let bytes = place.bytes(TokenFormat::F32);
    std::fs::write(place.path(), &bytes[..1000]).unwrap();
    scene().write(&place.path(), TokenFormat::F16).unwrap();

    let weights = place.0.path().join("model.safetensors");
    std::fs::write(&weights, b"weights").unwrap();
    let message = refusal(&weights);
    assert!(message.contains("the file there is no scene") && message.contains("choose another name"), "{message}");
    assert_eq!(std::fs::read(&weights).unwrap(), b"weights");
    assert!(refusal(place.0.path()).contains("is no regular file"));
    assert!(refusal(&place.0.path().join("no/room.clift")).contains("there is no folder"));
    assert!(refusal(&place.path().join("room.clift")).contains("there is no folder"));
    #[cfg(unix)]
    {
        let link = place.0.path().join("link.clift");
        std::os::unix::fs::symlink(place.path(), &link).unwrap();
        assert!(refusal(&link).contains("is no regular file"));
        assert!(link.is_symlink(), "stays a link");
    }
}

#[test]
fn poses_that_are_none_are_refused() {
    let place = Place::new();
    let f32 = TokenFormat::F32;
    assert!(place.with_tensor(f32, "context_c2w", 0, &2.0_f64.to_le_bytes()).contains("context camera 0 is no pose"));
    let message = place.with_tensor(f32, "context_c2w", 8 * 15, &0.5_f64.to_le_bytes());
    assert!(message.contains("context camera 0 is no pose: its last row is [0.0, 0.0, 0.0, 0.5]"), "{message}");
    let message = place.with_tensor(f32, "context_c2w", 8 * 5, &(-1.0_f64).to_le_bytes());
    assert!(message.contains("context camera 0 is no pose: its rotation mirrors"), "{message}");
    let message = place.with_tensor(f32, "context_c2w", 8 * 7, &1e5_f64.to_le_bytes());
    assert!(message.contains("context camera 0 stands at [-1.0, 100000.0"), "{message}");
    assert!(place.with_tensor(f32, "world_scale", 0, &0.0_f64.to_le_bytes()).contains("the scale of its poses is 0"));
    let negative = (-20.0_f64).to_le_bytes();
    assert!(place.with_tensor(f32, "context_intrinsics", 8, &negative).contains("has the intrinsics [20.0, -20.0"));
}

#[test]
fn patches_that_do_not_exist_or_come_twice_are_refused() {
    let place = Place::new();
    let ids = |at: usize, id: u32| place.with_tensor(TokenFormat::F32, "token_ids", 4 * at, &id.to_le_bytes());
    assert!(ids(1, 12).contains("token 1 is of patch 12 of 12"));
    assert!(ids(1, u32::MAX).contains("token 1 is of patch 4294967295 of 12"));
    assert!(ids(2, 0).contains("token 2 is of patch 0, as another is"));
    assert!(ids(1, 10).contains("the ray of token 1 is"), "a ray of another patch");
}

#[test]
fn sizes_that_do_not_fit_the_tokens_are_refused() {
    let place = Place::new();
    assert!(place.with_header("\"height\":\"16\"", "\"height\":\"17\"").contains("does not divide into patches"));
    assert!(place.with_header("\"height\":\"16\"", "\"height\":\"0\"").contains("does not divide into patches"));
    assert!(place.with_header("\"height\":\"16\"", "\"height\":\"8\"").contains("token 1 is of patch 11 of 6"));
    let message = place.with_header("\"width\":\"24\"", "\"width\":\"18446744073709551608\"");
    assert!(message.contains("larger than 16384"), "{message}");
    let message = place.with_header("patch_size\\\":8", "patch_size\\\":1");
    assert!(message.contains("the ray of token 0 is"), "{message}");
}

#[test]
fn more_patches_than_an_encoder_has_tokens_for_are_refused_before_they_are_counted() {
    let place = Place::new();
    let bytes = place.bytes(TokenFormat::F32);
    let header = String::from_utf8(bytes[8..8 + HEADER_BYTES].to_vec()).expect("text");
    let mut header = header.trim_end().replace("patch_size\\\":8", "patch_size\\\":1");
    header = header.replace("\"height\":\"16\"", "\"height\":\"16384\"").replace("\"24\"", "\"16384\"");
    let length = (header.len() as u64).to_le_bytes();
    let message = place.refused(&[&length[..], header.as_bytes(), &bytes[8 + HEADER_BYTES..]].concat());
    assert!(message.contains("its views have 536870912 patches, more than 1048576"), "{message}");
}

#[test]
fn a_scene_that_would_be_refused_is_not_written_and_a_failed_write_leaves_the_old_file() {
    let place = Place::new();
    let before = place.bytes(TokenFormat::F32);
    let mut broken = scene();
    broken.tokens[3] = f32::NAN;
    let message = broken.write(&place.path(), TokenFormat::F32).unwrap_err().to_string();
    assert!(message.starts_with("cannot write the scene: token 0 holds NaN"), "{message}");
    let long = Scene { key: "k".repeat(1800), ..scene() };
    let message = long.write(&place.path(), TokenFormat::F32).unwrap_err().to_string();
    assert!(message.contains("longer than"), "{message}");
    let large = Scene { tokens: vec![1e5; 5 * DIM], ..scene() };
    assert!(large.write(&place.path(), TokenFormat::F16).is_err());
    assert_eq!(std::fs::read(place.path()).expect("still there"), before);
    assert_eq!(std::fs::read_dir(place.0.path()).expect("a folder").count(), 1);
    let message = scene().write(&place.0.path().join("no/room.clift"), TokenFormat::F32).unwrap_err().to_string();
    assert!(message.contains("choose a folder that exists"), "{message}");
}
