//! The readers of layouts with files per scene or frame, of which one is damaged, and of published checkpoints.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use clift_data::{DatasetRoot, SourceOptions, Split, TestScenes, open_source};
use clift_model::CliftVariant;
use clift_train::{ImportOptions, import};

use crate::setup::{Setup, fixture};
use crate::targets::{JSON_WORDS, PICKLE_WORDS, PLAIN, Read, Target, words_of};

const KEY: &str = "d6b00d693f813db59886beb214cc6e1939fe3d29fc1b4349616adf2d36ebdc6a";
const TRANSFORMS: &str = "layouts/capture/attic/transforms.json";
const CAMERAS_BIN: &str = "layouts/colmap_bin/attic/sparse/0/cameras.bin";
const IMAGES_BIN: &str = "layouts/colmap_bin/attic/sparse/0/images.bin";
const CAMERAS_TXT: &str = "layouts/colmap_txt/attic/sparse/0/cameras.txt";
const IMAGES_TXT: &str = "layouts/colmap_txt/attic/sparse/0/images.txt";

/// All of them.
pub const LAYOUT_TARGETS: &[Target] = &[
    Target {
        name: "transforms",
        seeds: |_| vec![fixture(TRANSFORMS)],
        open: |setup| scene(setup, TRANSFORMS),
        words: TRANSFORMS_WORDS,
        ..PLAIN
    },
    Target {
        name: "colmap-cameras-bin",
        seeds: |_| vec![fixture(CAMERAS_BIN)],
        open: |setup| scene(setup, CAMERAS_BIN),
        words: BINARY_WORDS,
        ..PLAIN
    },
    Target {
        name: "colmap-images-bin",
        seeds: |_| vec![fixture(IMAGES_BIN)],
        open: |setup| scene(setup, IMAGES_BIN),
        words: BINARY_WORDS,
        ..PLAIN
    },
    Target {
        name: "colmap-cameras-txt",
        seeds: |_| vec![fixture(CAMERAS_TXT)],
        open: |setup| scene(setup, CAMERAS_TXT),
        words: TEXT_WORDS,
        ..PLAIN
    },
    Target {
        name: "colmap-images-txt",
        seeds: |_| vec![fixture(IMAGES_TXT)],
        open: |setup| scene(setup, IMAGES_TXT),
        words: TEXT_WORDS,
        ..PLAIN
    },
    Target {
        name: "re10k-text",
        seeds: |_| vec![fixture(&format!("layouts/re10k_txt/test/{KEY}.txt"))],
        open: |setup| scene(setup, &format!("layouts/re10k_txt/test/{KEY}.txt")),
        words: TEXT_WORDS,
        ..PLAIN
    },
    Target {
        name: "scene-torch",
        seeds: |_| vec![fixture(&format!("layouts/scenes/test/{KEY}.torch"))],
        open: |setup| scene(setup, &format!("layouts/scenes/test/{KEY}.torch")),
        words: PICKLE_WORDS,
        ..PLAIN
    },
    Target {
        name: "published-checkpoint",
        seeds: |_| vec![fixture("checkpoints/re10k.ckpt")],
        open: published_checkpoint,
        words: PICKLE_WORDS,
        ..PLAIN
    },
    Target {
        name: "test-scenes",
        seeds: |_| vec![fixture("re10k-mini/evaluation_index.json"), b"[\"a\", \"b\"]".to_vec(), b"a\nb\n".to_vec()],
        open: test_scenes,
        words: JSON_WORDS,
        ..PLAIN
    },
];

const TRANSFORMS_WORDS: &[&[u8]] = &[
    b"{",
    b"}",
    b"[",
    b"]",
    b"null",
    b"-1",
    b"1e400",
    b"1e-300",
    b"NaN",
    b",",
    b"\"k1\": 1e9, ",
    b"\"k1\": -0.3, ",
    b"\"w\": 1e300, ",
    b"\"camera_angle_x\": 3.2, ",
    b"\"file_path\": \"/dev/zero\"",
    b"../../",
    b"\\u0000",
    b"\xff",
    b"\"images\\\\8\"",
    b"[[[[[[[[[[[[",
];
const BINARY_WORDS: &[&[u8]] = &[
    b"\x00\x00\x00\x00\x00\x00\xf0\x7f",
    b"\x00\x00\x00\x00\x00\x00\xf8\x7f",
    b"\xff\xff\xff\xff\xff\xff\xff\xff",
    b"\xff\xff\xff\xff\xff\xff\xff\x7f",
    b"\xaa\xaa\xaa\xaa\xaa\xaa\xaa\x0a",
    b"\x00\x00\x00\x00",
    b"\x05\x00\x00\x00",
    b"\x00",
    b"../",
    b"/dev/zero\x00",
];
const TEXT_WORDS: &[&[u8]] = &[
    b"\n",
    b"\n\n",
    b"#",
    b" ",
    b"nan",
    b"-inf",
    b"1e400",
    b"-1",
    b"OPENCV",
    b"FULL_OPENCV",
    b"../",
    b"/dev/zero",
    b"\xff",
    b"\0",
    b"9223372036854775808",
];

/// A copy of the data set that `path` is part of, read with what is in the file replaced.
fn scene(setup: &Setup, path: &str) -> Read {
    let mut parts = path.splitn(3, '/');
    let (Some(above), Some(layout), Some(inside)) = (parts.next(), parts.next(), parts.next()) else {
        panic!("{path} is no file of a layout")
    };
    let root = setup.fresh(&path.replace('/', "-"));
    let fixtures = Path::new(env!("CARGO_MANIFEST_DIR")).join("../data-fixtures");
    copy_folder(&fixtures.join(above).join(layout), &root);
    let file = root.join(inside);
    Box::new(move |bytes| {
        std::fs::write(&file, bytes).expect("a temporary folder is writable");
        let opened =
            DatasetRoot::find(&root).and_then(|root| open_source(&root, Split::Test, &SourceOptions::default()));
        let source = opened.map_err(words_of)?.source;
        for scene in 0..source.num_scenes() {
            source.cameras(scene).map_err(words_of)?;
            source.timestamps(scene).map_err(words_of)?;
            for frame in 0..source.num_frames(scene).map_err(words_of)?.min(3) {
                source.frame(scene, frame).map_err(words_of)?;
            }
        }
        Ok(())
    })
}

fn published_checkpoint(setup: &Setup) -> Read {
    let folder = setup.fresh("published-checkpoint");
    let (file, out) = (folder.join("last.ckpt"), folder.join("model"));
    let options =
        ImportOptions { variant: CliftVariant::ReleasedRe10k, num_heads: Some(3), convert: true, renames: Vec::new() };
    Box::new(move |bytes| {
        std::fs::write(&file, bytes).expect("a temporary folder is writable");
        let imported = import(&file, &out, &options, &AtomicBool::new(false)).map(drop).map_err(words_of);
        if imported.is_ok() {
            std::fs::remove_dir_all(&out).expect("a model was written");
        } else {
            assert!(!out.exists(), "what is refused leaves nothing behind");
        }
        imported
    })
}

fn test_scenes(setup: &Setup) -> Read {
    let path = setup.fresh("test-scenes").join("list");
    Box::new(move |bytes| {
        std::fs::write(&path, bytes).expect("a temporary folder is writable");
        TestScenes::read(&path).map(drop).map_err(words_of)
    })
}

fn copy_folder(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).expect("a temporary folder is writable");
    for entry in std::fs::read_dir(from).expect("the fixtures are there") {
        let path = entry.expect("it can be listed").path();
        let target = to.join(path.file_name().expect("it has a name"));
        if path.is_dir() {
            copy_folder(&path, &target);
        } else {
            std::fs::copy(&path, &target).expect("it can be copied");
        }
    }
}
