//! The table of readers.

use crate::readers::{self, Read};
use crate::setup::{Setup, fixture, member, read};
use crate::words;

type Seeds = fn(&Setup, &'static str) -> Vec<Vec<u8>>;
type Open = fn(&Setup, &'static str) -> Read;

pub struct Target {
    pub name: &'static str,
    /// File that is damaged: a path below `data-fixtures` or in the run.
    pub file: &'static str,
    pub seeds: Seeds,
    pub open: Open,
    /// Words of the format, see [`words::list`].
    pub words: &'static [u8],
    pub repair: fn(&mut [u8]),
    /// Most bytes of memory for an input of a length.
    pub most_bytes: fn(usize) -> usize,
}

/// A reader without checksums that takes a fixed amount of memory and a multiple of the input.
const fn target(name: &'static str, file: &'static str, seeds: Seeds, open: Open, words: &'static [u8]) -> Target {
    Target { name, file, seeds, open, words, repair: |_| (), most_bytes: |len| (64 << 20) + 64 * len }
}

const fn layout(name: &'static str, file: &'static str, words: &'static [u8]) -> Target {
    target(name, file, fixtures, readers::layout, words)
}

const fn checkpoint(name: &'static str, file: &'static str, words: &'static [u8]) -> Target {
    target(name, file, of_checkpoint, readers::checkpoint, words)
}

/// An image of a few bytes may have 8,192 x 8,192 pixels: the decoder's limit, the image and its conversion.
const IMAGE_BYTES: fn(usize) -> usize = |len| (1200 << 20) + 64 * len;

const CHUNK: &str = readers::CHUNK;
const INDEX: &str = "re10k-mini/evaluation_index.json";
const RE10K_TEXT: &str = "layouts/re10k_txt/test/d6b00d693f813db59886beb214cc6e1939fe3d29fc1b4349616adf2d36ebdc6a.txt";
const SCENE_TORCH: &str = "layouts/scenes/test/d6b00d693f813db59886beb214cc6e1939fe3d29fc1b4349616adf2d36ebdc6a.torch";

/// All readers. A new reader is a line here and, where it needs more than its bytes, a function in [`readers`].
pub const TARGETS: &[Target] = &[
    target("pickle", CHUNK, pickles, readers::pickle, words::PICKLE),
    target("chunk", CHUNK, fixtures, readers::chunk, b""),
    target("chunk-pickle", CHUNK, pickles, readers::chunk_pickle, words::PICKLE),
    target("chunk-index", readers::CHUNK_INDEX, fixtures, readers::chunk, words::JSON),
    Target {
        repair: png_checksums,
        most_bytes: IMAGE_BYTES,
        ..target("image-png", "", |_, _| readers::pngs(), readers::image, words::PNG)
    },
    Target {
        most_bytes: IMAGE_BYTES,
        ..target("image-jpeg", "", |_, _| readers::jpegs(), readers::image, words::JPEG)
    },
    target("evaluation-index", INDEX, fixtures, readers::evaluation_index, words::JSON),
    target("config", "config.toml", configs, readers::config, words::TOML),
    target("scene-file", "room.clift", rooms, readers::scene_file, words::SAFETENSORS),
    target("coded-scene", "coded.clift", coded_rooms, readers::scene_file, words::SAFETENSORS),
    Target {
        repair: scene_checksum,
        ..target("coded-scene-checked", "checked.clift", coded_rooms, readers::scene_file, words::SAFETENSORS)
    },
    target("token-codec", "stage2/codec.safetensors", of_run, readers::token_codec, words::SAFETENSORS),
    target("weights", "stage1/model.safetensors", of_run, readers::weights, words::SAFETENSORS),
    checkpoint("checkpoint-model", "model.bpk", words::SAFETENSORS),
    checkpoint("checkpoint-optimizer", "optimizer.bpk", words::SAFETENSORS),
    checkpoint("checkpoint-state", "state.json", words::JSON),
    target("clusters-index", "clusters/index.json", of_run, readers::clusters, words::JSON),
    target("clusters-data", "clusters/clusters.bin", of_run, readers::clusters, b""),
    target("run-file", "run.json", of_run, readers::run_file, words::JSON),
    layout("transforms", "layouts/capture/attic/transforms.json", words::TRANSFORMS),
    layout("colmap-cameras-bin", "layouts/colmap_bin/attic/sparse/0/cameras.bin", words::BINARY),
    layout("colmap-images-bin", "layouts/colmap_bin/attic/sparse/0/images.bin", words::BINARY),
    layout("colmap-cameras-txt", "layouts/colmap_txt/attic/sparse/0/cameras.txt", words::TEXT),
    layout("colmap-images-txt", "layouts/colmap_txt/attic/sparse/0/images.txt", words::TEXT),
    layout("re10k-text", RE10K_TEXT, words::TEXT),
    layout("scene-torch", SCENE_TORCH, words::PICKLE),
    target("published-checkpoint", "checkpoints/re10k.ckpt", fixtures, readers::published_checkpoint, words::PICKLE),
    target("test-scenes", INDEX, test_scenes, readers::test_scenes, words::JSON),
];

fn fixtures(_: &Setup, file: &'static str) -> Vec<Vec<u8>> {
    vec![fixture(file)]
}

fn pickles(_: &Setup, file: &'static str) -> Vec<Vec<u8>> {
    vec![member(&fixture(file), "data.pkl")]
}

fn of_run(setup: &Setup, file: &'static str) -> Vec<Vec<u8>> {
    vec![read(&setup.at("run").join(file))]
}

fn of_checkpoint(setup: &Setup, file: &'static str) -> Vec<Vec<u8>> {
    vec![read(&setup.checkpoint().join(file))]
}

fn configs(setup: &Setup, file: &'static str) -> Vec<Vec<u8>> {
    vec![fixture("../configs/tiny.toml"), read(&setup.at("run").join(file))]
}

fn rooms(setup: &Setup, _: &'static str) -> Vec<Vec<u8>> {
    ["f32", "f16", "int8"].map(|name| read(&setup.at(&format!("room-{name}.clift")))).into()
}

fn coded_rooms(setup: &Setup, _: &'static str) -> Vec<Vec<u8>> {
    vec![read(&setup.at("room-coded.clift"))]
}

fn test_scenes(_: &Setup, file: &'static str) -> Vec<Vec<u8>> {
    vec![fixture(file), b"[\"a\", \"b\"]".to_vec(), b"a\nb\n".to_vec()]
}

/// Writes the checksum of a coded scene.
fn scene_checksum(bytes: &mut [u8]) {
    if let Some((checked, checksum)) = bytes.split_last_chunk_mut::<4>() {
        *checksum = crc32fast::hash(checked).to_le_bytes();
    }
}

/// Writes the checksum of every block of a PNG, as far as its blocks can be followed.
fn png_checksums(bytes: &mut [u8]) {
    let mut at = 8;
    while at + 12 <= bytes.len() {
        let len = u32::from_be_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]) as usize;
        let Some(end) = at.checked_add(8).and_then(|start| start.checked_add(len)).filter(|end| end + 4 <= bytes.len())
        else {
            return;
        };
        let checksum = crc32fast::hash(&bytes[at + 4..end]).to_be_bytes();
        bytes[end..end + 4].copy_from_slice(&checksum);
        at = end + 4;
    }
}
