//! The table of readers.

use clift_data::{EvaluationIndex, TestScenes};
use clift_scene::{Scene, TokenCodec};
use clift_train::{Config, read_checked_config};

use crate::readers::{self, CHUNK, CHUNK_INDEX, Read, done, file};
use crate::setup::{Setup, fixture, member, read};
use crate::words;

pub struct Target {
    pub name: &'static str,
    /// Words of the format, see [`words::list`].
    pub words: &'static [u8],
    /// Returns valid files and their reader.
    pub open: Open,
    pub repair: fn(&mut [u8]),
    /// Most bytes of memory for an input of a length.
    pub most_bytes: fn(usize) -> usize,
}

type Open = fn(&Setup) -> (Vec<Vec<u8>>, Read);

/// A reader without checksums that takes a fixed amount of memory and a multiple of the input.
const fn target(name: &'static str, words: &'static [u8], open: Open) -> Target {
    Target { name, words, open, repair: |_| (), most_bytes: |len| (64 << 20) + 64 * len }
}

/// An image of a few bytes may have 8,192 x 8,192 pixels: the decoder's limit, the image and its conversion.
const fn image(name: &'static str, words: &'static [u8], open: Open) -> Target {
    Target { most_bytes: |len| (1200 << 20) + 64 * len, ..target(name, words, open) }
}

const INDEX: &str = "re10k-mini/evaluation_index.json";
const RE10K_TEXT: &str = "layouts/re10k_txt/test/d6b00d693f813db59886beb214cc6e1939fe3d29fc1b4349616adf2d36ebdc6a.txt";
const SCENE_TORCH: &str = "layouts/scenes/test/d6b00d693f813db59886beb214cc6e1939fe3d29fc1b4349616adf2d36ebdc6a.torch";

/// All readers. A new reader is a line here and, where it needs more than its bytes, a function in [`readers`].
pub const TARGETS: &[Target] = &[
    target("pickle", words::PICKLE, |_| (pickles(), readers::pickle())),
    target("chunk", b"", |s| (vec![fixture(CHUNK)], readers::chunk(s, CHUNK))),
    target("chunk-pickle", words::PICKLE, |s| (pickles(), readers::chunk_pickle(s))),
    target("chunk-index", words::JSON, |s| (vec![fixture(CHUNK_INDEX)], readers::chunk(s, CHUNK_INDEX))),
    Target { repair: png_checksums, ..image("image-png", words::PNG, |_| (readers::pngs(), readers::image())) },
    image("image-jpeg", words::JPEG, |_| (readers::jpegs(), readers::image())),
    target("evaluation-index", words::JSON, |s| {
        (vec![fixture(INDEX)], file(s, "index.json", |path| done(EvaluationIndex::read(path))))
    }),
    target("config", words::TOML, |s| {
        let of_run = read(&s.at("run/config.toml"));
        (
            vec![fixture("../configs/tiny.toml"), of_run],
            file(s, "config.toml", |path| done(read_checked_config(path, &[], Config::validate))),
        )
    }),
    target("scene-file", words::SAFETENSORS, |s| (["f32", "f16"].map(|format| room(s, format)).into(), scene_file(s))),
    Target {
        repair: scene_checksum,
        ..target("coded-scene", words::SAFETENSORS, |s| (vec![room(s, "coded")], scene_file(s)))
    },
    target("token-codec", words::SAFETENSORS, |s| {
        (of_run(s, "stage2/codec.safetensors"), file(s, "codec.safetensors", |path| done(TokenCodec::read(path))))
    }),
    target("weights", words::SAFETENSORS, |s| (of_run(s, "stage1/model.safetensors"), readers::weights(s))),
    target("checkpoint-model", words::SAFETENSORS, |s| readers::checkpoint(s, "model.bpk")),
    target("checkpoint-optimizer", words::SAFETENSORS, |s| readers::checkpoint(s, "optimizer.bpk")),
    target("checkpoint-state", words::JSON, |s| readers::checkpoint(s, "state.json")),
    target("clusters-index", words::JSON, |s| (of_run(s, "clusters/index.json"), readers::clusters(s, "index.json"))),
    target("clusters-data", b"", |s| (of_run(s, "clusters/clusters.bin"), readers::clusters(s, "clusters.bin"))),
    target("run-file", words::JSON, |s| (of_run(s, "run.json"), readers::run_file(s))),
    target("transforms", words::TRANSFORMS, |s| readers::layout(s, "layouts/capture/attic/transforms.json")),
    target("colmap-cameras-bin", words::BINARY, |s| {
        readers::layout(s, "layouts/colmap_bin/attic/sparse/0/cameras.bin")
    }),
    target("colmap-images-bin", words::BINARY, |s| readers::layout(s, "layouts/colmap_bin/attic/sparse/0/images.bin")),
    target("colmap-cameras-txt", words::TEXT, |s| readers::layout(s, "layouts/colmap_txt/attic/sparse/0/cameras.txt")),
    target("colmap-images-txt", words::TEXT, |s| readers::layout(s, "layouts/colmap_txt/attic/sparse/0/images.txt")),
    target("re10k-text", words::TEXT, |s| readers::layout(s, RE10K_TEXT)),
    target("scene-torch", words::PICKLE, |s| readers::layout(s, SCENE_TORCH)),
    target("published-checkpoint", words::PICKLE, |s| {
        (vec![fixture("checkpoints/re10k.ckpt")], readers::published_checkpoint(s))
    }),
    target("test-scenes", words::JSON, |s| {
        (
            vec![fixture(INDEX), b"[\"a\", \"b\"]".to_vec(), b"a\nb\n".to_vec()],
            file(s, "test-scenes", |path| done(TestScenes::read(path))),
        )
    }),
];

fn pickles() -> Vec<Vec<u8>> {
    vec![member(&fixture(CHUNK), "data.pkl")]
}

fn of_run(setup: &Setup, file: &str) -> Vec<Vec<u8>> {
    vec![read(&setup.at("run").join(file))]
}

fn scene_file(setup: &Setup) -> Read {
    file(setup, "room.clift", |path| done(Scene::read(path)))
}

fn room(setup: &Setup, format: &str) -> Vec<u8> {
    read(&setup.at(&format!("room-{format}.clift")))
}

/// Writes the checksum of a coded scene.
fn scene_checksum(bytes: &mut [u8]) {
    if let Some((checked, checksum)) = bytes.split_last_chunk_mut::<4>() {
        *checksum = crc32fast::hash(checked).to_le_bytes();
    }
}

/// Writes the checksum of every block of a PNG, as far as its blocks can be followed.
fn png_checksums(bytes: &mut [u8]) {
    let mut rest = bytes.get_mut(8..).unwrap_or_default();
    while let Some(len) = rest.first_chunk::<4>() {
        let end = 8 + u32::from_be_bytes(*len) as usize;
        let Some((block, after)) = rest.split_at_mut_checked(end) else { return };
        let Some((checksum, after)) = after.split_first_chunk_mut::<4>() else { return };
        *checksum = crc32fast::hash(&block[4..]).to_be_bytes();
        rest = after;
    }
}
