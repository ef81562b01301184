//! Scene files: round trips, sizes, and refused files.

use std::path::PathBuf;

use clift_core::{DMat3, DVec3, Intrinsics, Pose};
use clift_model::ModelError;
use safetensors::SafeTensors;

use super::*;
use crate::testing::small_lvsm;

const DIM: usize = 8;

pub(crate) fn camera(x: f64, angle: f64) -> Camera {
    let c2w = Pose { rotation: DMat3::from_rotation_y(angle), translation: DVec3::new(x, 0.1, -0.2) };
    Camera { c2w, intrinsics: Intrinsics { fx: 20.0, fy: 21.0, cx: 12.0, cy: 8.0 } }
}

/// Five tokens of two views of 24 x 16 pixels, which have six patches each.
pub(crate) fn scene() -> Scene {
    let token_ids = vec![0, 11, 3, 7, 8];
    Scene {
        key: "0123456789abcdef".into(),
        kind: TokenKind::Clift,
        model: ModelConfig { dim: DIM, num_heads: 2, ..ModelConfig::default() },
        renderer_hash: "0123456789abcdef".repeat(4),
        model_path: "runs/tiny".into(),
        height: 16,
        width: 24,
        context: vec![camera(-1.0, 0.2), camera(1.0, -0.3)],
        context_frames: vec![3, 41],
        groups: vec![ContextGroup::of_all(2)],
        world: PoseNormalization { mean_c2w: camera(17.0, 1.0).c2w, scale: 0.1 + 0.2 },
        tokens: (0..token_ids.len() * DIM).map(|i| (i as f32 - 17.0) * 0.317).collect(),
        token_ids,
    }
}

pub(crate) fn with_header(bytes: &[u8], changes: &[(&str, &str)]) -> Vec<u8> {
    let (length, rest) = bytes.split_first_chunk().expect("a length");
    let (header, rest) = rest.split_at(u64::from_le_bytes(*length) as usize);
    let mut header = std::str::from_utf8(header).expect("text").trim_end().to_owned();
    for (from, to) in changes {
        assert!(header.contains(from), "{from} is not in {header}");
        header = header.replace(from, to);
    }
    [&(header.len() as u64).to_le_bytes(), header.as_bytes(), rest].concat()
}

pub(crate) struct Folder(pub tempfile::TempDir);

impl Folder {
    pub fn new() -> Self {
        Self(tempfile::tempdir().expect("a temporary folder"))
    }

    pub fn path(&self) -> PathBuf {
        self.0.path().join("room.clift")
    }

    fn bytes(&self, scene: &Scene, format: TokenFormat) -> Vec<u8> {
        scene.write(&self.path(), format).expect("writes");
        std::fs::read(self.path()).expect("reads")
    }

    pub fn assert_refused(&self, bytes: &[u8], expected: &str) {
        std::fs::write(self.path(), bytes).expect("writes");
        let error = Scene::read(&self.path()).expect_err("an invalid file");
        std::fs::remove_file(self.path()).expect("removes");
        assert!(matches!(error, ModelError::SceneFile { .. }), "{error:?}");
        let message = error.to_string();
        assert!(message.starts_with("cannot use the scene: ") && message.ends_with("room.clift"), "{message}");
        assert!(message.contains(expected), "{message}\ndoes not contain\n{expected}");
    }

    fn assert_not_written(&self, scene: &Scene, format: TokenFormat, expected: &str) {
        let message = scene.write(&self.path(), format).unwrap_err().to_string();
        assert!(message.contains(expected), "{message}");
    }
}

#[test]
fn scenes_survive_a_file_whose_size_is_the_formula() {
    let folder = Folder::new();
    for (scene, place) in [(scene(), 28), (latents(), 0)] {
        for format in TokenFormat::ALL {
            let bytes = folder.bytes(&scene, format);
            let expected = 8 + 2048 + 136 + 164 * 2 + 140 + 4 * 2 + 5 * (place + format.bytes_per_token(DIM));
            assert_eq!((bytes.len(), scene.file_bytes(format)), (expected, expected as u64), "{format}");
            let tokens = format.round(&scene.tokens).expect("in range");
            assert_eq!(Scene::read(&folder.path()).expect("reads"), (Scene { tokens, ..scene.clone() }, format.into()));
            assert_eq!(folder.bytes(&scene, format), bytes, "equal scenes are equal files");
        }
    }
    assert_eq!(std::fs::read_dir(folder.0.path()).expect("a folder").count(), 1, "no temporary file is left");
}

/// Six tokens of two groups of two of three views; the second group has a frame of its own.
pub(crate) fn scene_of_groups() -> Scene {
    let frame = PoseNormalization { mean_c2w: camera(0.4, -0.1).c2w, scale: 2.5 };
    let token_ids = vec![0, 3, 11, 12, 20, 23];
    Scene {
        context: vec![camera(-1.0, 0.2), camera(0.3, 0.0), camera(1.0, -0.3)],
        context_frames: vec![3, 17, 41],
        groups: vec![
            ContextGroup { views: vec![0, 1], ..ContextGroup::of_all(0) },
            ContextGroup { views: vec![1, 2], frame },
        ],
        tokens: (0..token_ids.len() * DIM).map(|i| (i as f32 - 17.0) * 0.317).collect(),
        token_ids,
        ..scene()
    }
}

#[test]
fn groups_survive_a_file_and_own_the_tokens_of_their_views() {
    let folder = Folder::new();
    let scene = scene_of_groups();
    assert_eq!(folder.bytes(&scene, TokenFormat::F32).len() as u64, scene.file_bytes(TokenFormat::F32));
    assert_eq!(Scene::read(&folder.path()).expect("reads").0, scene);
    assert_eq!(scene.tokens_of_groups(), [vec![0, 1, 2], vec![3, 4, 5]]);
    // Token 3 is patch 12: the first of the first view of the second group, in the frame of that group.
    let c2w = scene.groups[1].frame.normalize(scene.context[1].c2w);
    let expected = Camera { c2w, ..scene.context[1] }.direction(4.0, 4.0);
    assert_eq!(scene.token_rays()[3].origin, c2w.translation);
    assert!(scene.token_rays()[3].direction.abs_diff_eq(expected, 1e-12));
    let learned = Scene { model: small_lvsm(), kind: TokenKind::All, ..scene };
    folder.assert_not_written(&learned, TokenFormat::F32, "2 groups of learned tokens, expected one");
}

fn latents() -> Scene {
    let model = ModelConfig { dim: DIM, num_heads: 2, num_latents: 5, ..small_lvsm() };
    Scene { kind: TokenKind::All, model, token_ids: (0..5).collect(), ..scene() }
}

#[test]
fn other_latents_than_those_of_the_network_are_refused() {
    let (folder, latents) = (Folder::new(), latents());
    let fewer = with_header(&folder.bytes(&latents, TokenFormat::F16), &[(r#"num_latents\":5"#, r#"num_latents\":4"#)]);
    folder.assert_refused(&fewer, "`tokens` is F16 [5, 8], expected F16 [4, 8]");
    let few = Scene { token_ids: vec![0, 1, 2, 4, 3], ..latents.clone() };
    folder.assert_not_written(&few, TokenFormat::F32, "expected all 5 learned tokens in order");
    let kind = Scene { kind: TokenKind::Clift, ..latents };
    folder.assert_not_written(&kind, TokenFormat::F32, "clift tokens of a network of lvsm-ed");
}

#[test]
fn damaged_files_are_refused_with_a_remedy() {
    let folder = Folder::new();
    folder.assert_refused(&[9, 0, 0], "the file is truncated: 3 bytes; copy it again");
    folder.assert_refused(b"\x89PNG\r\n\x1a\n and so on", "give a file that `clift encode` wrote");
    let bytes = folder.bytes(&scene(), TokenFormat::F16);
    let length = 8 + HEADER_BYTES - 1;
    folder.assert_refused(&bytes[..length], "truncated: 2055 bytes with a header of 2048 bytes; copy");
    let cut = "the file is truncated or has bytes after its last tensor; copy it again";
    for bytes in [&bytes[..8 + HEADER_BYTES], &bytes[..bytes.len() - 1], &[&bytes[..], &[0]].concat()[..]] {
        folder.assert_refused(bytes, cut);
    }
    for length in [u64::MAX, (1 << 16) + 1] {
        let bytes = [&length.to_le_bytes()[..], &bytes[8..]].concat();
        folder.assert_refused(&bytes, &format!("header of {length} bytes, expected at most 65536"));
    }
    let file = std::fs::File::create(folder.path()).expect("creates");
    file.set_len((1 << 30) + 1).expect("a sparse file");
    let large = Scene::read(&folder.path()).unwrap_err().to_string();
    assert!(large.contains("the file has 1073741825 bytes, a scene at most 1073741824"), "{large}");
}

#[test]
fn invalid_headers_are_refused() {
    let folder = Folder::new();
    let bytes = folder.bytes(&scene(), TokenFormat::F32);
    let refused =
        |changes: &[(&str, &str)], expected: &str| folder.assert_refused(&with_header(&bytes, changes), expected);
    for field in ["kind", "model", "renderer", "key", "height", "model_path"] {
        let [from, to] = ["", "not_"].map(|start| format!("\"{start}{field}\":"));
        refused(&[(&from, &to)], &format!("no `{field}` in the header; encode the scene again"));
    }
    let other_version =
        "scene file of version 9, this clift reads versions 6 and 7; encode the scene again, or render it";
    for (from, to, expected) in [
        (r#""format":"clift-scene""#, r#""format":"clift-1""#, "its header lacks the scene format; give a file"),
        (r#"{"__metadata__""#, r#"{"__metadata__"#, "unreadable header"),
        (r#""version":"6""#, r#""version":"9""#, other_version),
        (r#""width":"24""#, r#""width":"-24""#, r#"width "-24", expected a number"#),
        (r#""renderer":"0123"#, r#""renderer":"zz23"#, "expected 64 hexadecimal digits"),
        // Sizes of the model and of the views.
        ("num_heads", "num_hands", "unreadable `model` (unknown field"),
        (r#"\"dim\":8"#, r#"\"dim\":99999999999"#, "`model.dim` = 99999999999: write at most 65536"),
        (r#"patch_size\":8"#, r#"patch_size\":1"#, "ray of token 0: "),
        (r#""height":"16""#, r#""height":"8""#, "token 1 of patch 11, expected less than 6"),
        (r#""width":"24""#, r#""width":"18446744073709551608""#, "expected at most 16384 a side"),
        // Names, types and shapes of tensors.
        (r#""shape":[5, 8]"#, r#""shape":[8, 5]"#, "`tokens` is F32 [8, 5], expected F32 [5, 8]"),
        (r#""F32","shape":[5, 8]"#, r#""I32","shape":[5, 8]"#, "`tokens` is I32, expected F32 or F16"),
        (r#""U32","shape":[5]"#, r#""U32","shape":[5, 1]"#, "`token_ids` has the shape [5, 1], expected one dimension"),
        (r#""tokens":"#, r#""tokens":{"dtype":"F32","shape":[0],"data_offsets":[0,0]},"more":"#, ""),
    ] {
        refused(&[(from, to)], expected);
    }
    let large = [
        (r#"patch_size\":8"#, r#"patch_size\":1"#),
        (r#""height":"16""#, r#""height":"16384""#),
        ("\"24\"", "\"16384\""),
    ];
    refused(&large, "536870912 patches of context views, expected at most 1048576");
}

#[test]
fn invalid_tensor_values_are_refused() {
    let (f32_nan, f64_nan) = (f32::NAN.to_le_bytes(), f64::NAN.to_le_bytes());
    let [f32, f16] = TokenFormat::ALL;
    let last_row = "context camera 0: bad camera: the last row of the pose is [0.0, 0.0, 0.0, 0.5]";
    let cases: &[(TokenFormat, &str, usize, &[u8], &str)] = &[
        (f32, "tokens", 4 * 17, &f32_nan, "token 2 contains NaN"),
        (f16, "tokens", 2 * 8, &half::f16::INFINITY.to_le_bytes(), "token 1 contains inf"),
        (f32, "token_rays", 24 + 8, &f32_nan, "ray of token 1: "),
        (f32, "context_c2w", 8 * 16, &f64_nan, "context camera 1: bad camera: the pose holds NaN"),
        (f32, "context_c2w", 8 * 15, &0.5_f64.to_le_bytes(), last_row),
        (f32, "context_c2w", 8 * 7, &1e5_f64.to_le_bytes(), "context camera 0: bad camera: the camera is 100000 times"),
        (f32, "context_intrinsics", 8, &(-20.0_f64).to_le_bytes(), "context camera 0: bad camera: fy is -20"),
        (f32, "world_mean_c2w", 8, &f64_nan, "mean pose: bad camera: the pose holds NaN"),
        (f32, "group_sizes", 0, &1_u32.to_le_bytes(), "1 views after the last group"),
        (f32, "group_sizes", 0, &3_u32.to_le_bytes(), "group 0 has 3 views, 2 are left of 2"),
        (f32, "group_views", 4, &2_u32.to_le_bytes(), "a group of context view 2, expected less than 2"),
        (f32, "group_scale", 0, &0.0_f64.to_le_bytes(), "pose scale 0"),
        (f32, "token_ids", 4, &12_u32.to_le_bytes(), "token 1 of patch 12, expected less than 12"),
        (f32, "token_ids", 8, &0_u32.to_le_bytes(), "two tokens of patch 0, the second is token 2"),
        (f32, "token_ids", 4, &10_u32.to_le_bytes(), "ray of token 1: "),
    ];
    let folder = Folder::new();
    for &(format, name, at, data, expected) in cases {
        let mut bytes = folder.bytes(&scene(), format);
        let file = SafeTensors::deserialize(&bytes).expect("valid");
        let start = file.tensor(name).expect("there").data().as_ptr() as usize - bytes.as_ptr() as usize;
        bytes[start + at..][..data.len()].copy_from_slice(data);
        folder.assert_refused(&bytes, expected);
    }
}

#[test]
fn a_failed_write_leaves_the_old_file() {
    let folder = Folder::new();
    let before = folder.bytes(&scene(), TokenFormat::F32);
    let mut broken = scene();
    broken.tokens[3] = f32::NAN;
    for (scene, format, expected) in [
        (broken, TokenFormat::F32, "cannot write the scene: token 0 contains NaN"),
        (Scene { key: "k".repeat(1800), ..scene() }, TokenFormat::F32, "together are longer than"),
        (Scene { tokens: vec![1e5; 5 * DIM], ..scene() }, TokenFormat::F16, "a token contains 100000"),
    ] {
        folder.assert_not_written(&scene, format, expected);
    }
    assert_eq!(std::fs::read(folder.path()).expect("still there"), before);
    assert_eq!(std::fs::read_dir(folder.0.path()).expect("a folder").count(), 1);
    // Files that are not scenes, and links, stay; a truncated scene is replaced.
    std::fs::write(folder.path(), &before[..1000]).unwrap();
    folder.bytes(&scene(), TokenFormat::F16);
    std::fs::write(folder.path(), b"weights").unwrap();
    folder.assert_not_written(&scene(), TokenFormat::F16, "the existing file is not a scene, and only scenes are");
    std::fs::rename(folder.path(), folder.0.path().join("weights")).unwrap();
    #[cfg(unix)]
    {
        std::os::unix::fs::symlink(folder.0.path().join("weights"), folder.path()).unwrap();
        folder.assert_not_written(&scene(), TokenFormat::F16, "is not a regular file");
    }
}
