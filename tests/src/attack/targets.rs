//! The readers, one line of a table each.

use std::path::Path;

use burn::tensor::Device;
use clift_data::{
    ChunkSource, EvaluationIndex, Pickle, SceneFilters, SceneSource, Split, decode_image, encode_jpeg, encode_png,
};
use clift_model::{Clift, Scene, load_part};
use clift_train::{
    CheckpointConfig, Checkpoints, ClusterCache, Config, Loss, OptimizerConfig, Run, TrainState, adamw,
    read_checked_config,
};

use crate::setup::{Setup, fixture, member, with_pickle};

/// Reads bytes to the end, and tells why it refused them.
pub type Read = Box<dyn FnMut(&[u8]) -> Result<(), String>>;

/// One reader.
pub struct Target {
    /// Its name.
    pub name: &'static str,
    /// Files that it accepts.
    pub seeds: fn(&Setup) -> Vec<Vec<u8>>,
    /// Makes it.
    pub open: fn(&Setup) -> Read,
    /// Words of its format.
    pub words: &'static [&'static [u8]],
    /// Puts checksums right.
    pub repair: fn(&mut [u8]),
    /// Most bytes it may take for an input of so many.
    pub most_bytes: fn(usize) -> usize,
}

/// All of them. A new reader is a line here and, where it needs more than its bytes, a function below.
pub const TARGETS: &[Target] = &[
    Target { name: "pickle", seeds: pickles, open: pickle, words: PICKLE_WORDS, ..PLAIN },
    Target { name: "chunk", seeds: |_| vec![chunk_file()], open: |s| chunk(s, <[u8]>::to_vec), ..PLAIN },
    Target {
        name: "chunk-pickle",
        seeds: |_| vec![member(&chunk_file(), "data.pkl")],
        open: |setup| chunk(setup, |bytes| with_pickle(&chunk_file(), bytes)),
        words: PICKLE_WORDS,
        ..PLAIN
    },
    Target {
        name: "chunk-index",
        seeds: |_| vec![fixture(CHUNK_INDEX)],
        open: chunk_index,
        words: JSON_WORDS,
        ..PLAIN
    },
    Target {
        name: "image-png",
        seeds: pngs,
        open: picture,
        words: PNG_WORDS,
        repair: png_checksums,
        most_bytes: PICTURE,
    },
    Target { name: "image-jpeg", seeds: jpegs, open: picture, words: JPEG_WORDS, most_bytes: PICTURE, ..PLAIN },
    Target {
        name: "evaluation-index",
        seeds: |_| vec![fixture("re10k-mini/evaluation_index.json")],
        open: |setup| file(setup, "index.json", |path| EvaluationIndex::read(path).map(drop).map_err(words_of)),
        words: JSON_WORDS,
        ..PLAIN
    },
    Target { name: "config", seeds: configs, open: config, words: TOML_WORDS, ..PLAIN },
    Target {
        name: "scene-file",
        seeds: |setup| ["f32", "f16", "int8"].map(|name| read(&setup.at(&format!("room-{name}.clift")))).into(),
        open: |setup| file(setup, "room.clift", |path| Scene::read(path).map(drop).map_err(words_of)),
        words: SAFETENSORS_WORDS,
        ..PLAIN
    },
    Target {
        name: "weights",
        seeds: |setup| vec![read(&setup.run().join("stage1/model.safetensors"))],
        open: model_weights,
        words: SAFETENSORS_WORDS,
        ..PLAIN
    },
    Target {
        name: "checkpoint-model",
        seeds: |setup| vec![read(&setup.checkpoint().join("model.bpk"))],
        open: |setup| checkpoint(setup, "model.bpk"),
        words: SAFETENSORS_WORDS,
        ..PLAIN
    },
    Target {
        name: "checkpoint-optimizer",
        seeds: |setup| vec![read(&setup.checkpoint().join("optimizer.bpk"))],
        open: |setup| checkpoint(setup, "optimizer.bpk"),
        words: SAFETENSORS_WORDS,
        ..PLAIN
    },
    Target {
        name: "checkpoint-state",
        seeds: |setup| vec![read(&setup.checkpoint().join("state.json"))],
        open: |setup| checkpoint(setup, "state.json"),
        words: JSON_WORDS,
        ..PLAIN
    },
    Target {
        name: "clusters-index",
        seeds: |setup| vec![read(&setup.run().join("clusters/index.json"))],
        open: |setup| clusters(setup, "index.json"),
        words: JSON_WORDS,
        ..PLAIN
    },
    Target {
        name: "clusters-data",
        seeds: |setup| vec![read(&setup.run().join("clusters/clusters.bin"))],
        open: |setup| clusters(setup, "clusters.bin"),
        ..PLAIN
    },
    Target {
        name: "run-file",
        seeds: |setup| vec![read(&setup.run().join("run.json"))],
        open: run_file,
        words: JSON_WORDS,
        ..PLAIN
    },
];

/// A reader without words and checksums, which takes a fixed amount and a multiple of its input.
pub const PLAIN: Target = Target {
    name: "",
    seeds: |_| Vec::new(),
    open: |_| Box::new(|_| Ok(())),
    words: &[],
    repair: |_| (),
    most_bytes: |len| (64 << 20) + 64 * len,
};

/// A picture of a few bytes may have 8,192 x 8,192 pixels: the decoder's limit, the picture and its conversion.
const PICTURE: fn(usize) -> usize = |len| (1200 << 20) + 64 * len;

pub const PICKLE_WORDS: &[&[u8]] = &[
    b"\x80\x02",
    b"]",
    b"}",
    b")",
    b"(",
    b"q\x00",
    b"h\x00",
    b"r\xff\xff\xff\xff",
    b"j\xff\xff\xff\x7f",
    b"0",
    b"1",
    b"2",
    b"a",
    b"e",
    b"s",
    b"u",
    b"t",
    b"\x85",
    b"\x86",
    b"\x87",
    b"R",
    b"Q",
    b".",
    b"K\xff",
    b"J\xff\xff\xff\xff",
    b"\x8a\x08\xff\xff\xff\xff\xff\xff\xff\x7f",
    b"\x8a\xff",
    b"X\xff\xff\xff\xff",
    b"X\xff\xff\xff\x7f",
    b"\x8c\xff",
    b"\x8d\xff\xff\xff\xff\xff\xff\xff\xff",
    b"G\x7f\xf8\x00\x00\x00\x00\x00\x00",
    b"\x88",
    b"\x89",
    b"N",
    b"\x94",
    b"\x93",
    b"\x95\xff\xff\xff\xff\xff\xff\xff\x7f",
    b"b",
    b"cos\nsystem\n",
    b"ctorch._utils\n_rebuild_tensor_v2\n",
    b"ctorch\nByteStorage\n",
    b"ctorch\nFloatStorage\n",
    b"ccollections\nOrderedDict\n",
    b"((((((((",
    b"))))))))",
];
pub const JSON_WORDS: &[&[u8]] = &[
    b"{",
    b"}",
    b"[",
    b"]",
    b"null",
    b"true",
    b"-1",
    b"1e400",
    b"\"\"",
    b",",
    b":",
    b"\\u0000",
    b"\xff",
    b"[[[[[[[[[[[[",
    b"{\"a\":{\"a\":{\"a\":",
    b"../../",
    b"/dev/zero",
    b"\"context\"",
    b"\"target\"",
    b"\"num_tokens\"",
    b"\"offset_bytes\"",
];
const TOML_WORDS: &[&[u8]] = &[
    b"[",
    b"]",
    b"[[",
    b"]]",
    b"=",
    b"\"\"\"",
    b"'",
    b"#",
    b"nan",
    b"-inf",
    b"inf",
    b"0x7fffffffffffffff",
    b"1e400",
    b"true",
    b"[model]\n",
    b"[data.views]\n",
    b"[stage1.optimizer]\n",
    b"dim = 0\n",
    b"patch_size = 0\n",
    b"\xff",
    b"\n",
    b"{",
    b"}",
    b"num_heads = 0\n",
    b"grid = []\n",
    b"[[[[[[[[[[[[[[[[",
    b"a.b.c.d.e.f = 1\n",
    b"\"1/0\"",
    b"2024-01-01T00:00:00Z",
];
const SAFETENSORS_WORDS: &[&[u8]] = &[
    b"\"dtype\":\"F32\"",
    b"\"dtype\":\"F64\"",
    b"\"shape\":[",
    b"\"data_offsets\":[0,",
    b"__metadata__",
    b"{",
    b"}",
    b"\"F16\"",
    b"18446744073709551615",
    b"4294967296",
    b"[0]",
    b"[]",
    b"\xff\xff\xff\xff\xff\xff\xff\x7f",
    b"\x00\x00\x80\x7f",
    b"NaN",
    b"\x00\x00\xc0\x7f",
];
const PNG_WORDS: &[&[u8]] =
    &[b"IHDR", b"IDAT", b"PLTE", b"tRNS", b"IEND", b"acTL", b"fcTL", b"iCCP", b"\x00\x00\x40\x00", b"\x10", b"\x03"];
const JPEG_WORDS: &[&[u8]] = &[
    b"\xff\xd8",
    b"\xff\xd9",
    b"\xff\xda",
    b"\xff\xc0",
    b"\xff\xc2",
    b"\xff\xc4",
    b"\xff\xdb",
    b"\xff\xdd\x00\x04",
    b"\xff\xe1",
    b"\xff",
];

const CHUNK: &str = "re10k-mini/train/000000.torch";
const CHUNK_INDEX: &str = "re10k-mini/train/index.json";

fn chunk_file() -> Vec<u8> {
    fixture(CHUNK)
}

fn read(path: &Path) -> Vec<u8> {
    std::fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

pub fn words_of(error: impl std::fmt::Display) -> String {
    error.to_string()
}

/// A reader of one file.
fn file(setup: &Setup, name: &str, read: impl Fn(&Path) -> Result<(), String> + 'static) -> Read {
    let path = setup.fresh(name).join(name);
    Box::new(move |bytes| {
        std::fs::write(&path, bytes).expect("a temporary folder is writable");
        read(&path)
    })
}

fn pickles(_: &Setup) -> Vec<Vec<u8>> {
    vec![member(&chunk_file(), "data.pkl")]
}

fn pickle(_: &Setup) -> Read {
    Box::new(|bytes| Pickle::parse(bytes, Path::new("attack.pkl")).map(drop).map_err(words_of))
}

/// Reads everything of every scene of a chunk.
fn chunk(setup: &Setup, make: impl Fn(&[u8]) -> Vec<u8> + 'static) -> Read {
    let root = setup.fresh("chunk");
    std::fs::create_dir_all(root.join("train")).expect("a temporary folder is writable");
    std::fs::write(root.join("train/index.json"), fixture(CHUNK_INDEX)).expect("a temporary folder is writable");
    Box::new(move |bytes| {
        std::fs::write(root.join("train/000000.torch"), make(bytes)).expect("a temporary folder is writable");
        scenes(&root)
    })
}

fn scenes(root: &Path) -> Result<(), String> {
    let source = ChunkSource::open(root, Split::Train, &SceneFilters::default()).map_err(words_of)?;
    for scene in 0..source.num_scenes() {
        let num_frames = source.num_frames(scene).map_err(words_of)?;
        source.cameras(scene).map_err(words_of)?;
        source.timestamps(scene).map_err(words_of)?;
        source.url(scene).map_err(words_of)?;
        for frame in 0..num_frames.min(3) {
            source.frame(scene, frame).map_err(words_of)?;
        }
    }
    Ok(())
}

fn chunk_index(setup: &Setup) -> Read {
    let root = setup.fresh("chunk-index");
    std::fs::create_dir_all(root.join("train")).expect("a temporary folder is writable");
    std::fs::write(root.join("train/000000.torch"), chunk_file()).expect("a temporary folder is writable");
    Box::new(move |bytes| {
        std::fs::write(root.join("train/index.json"), bytes).expect("a temporary folder is writable");
        scenes(&root)
    })
}

/// Frames of 40 x 24 pixels with something in them.
fn frame() -> clift_data::RgbImage {
    let rgb = (0..40 * 24 * 3).map(|i: usize| (i * 7 % 251) as u8).collect();
    clift_data::RgbImage { width: 40, height: 24, rgb }
}

fn pngs(_: &Setup) -> Vec<Vec<u8>> {
    vec![encode_png(&frame()).expect("it can be encoded")]
}

fn jpegs(_: &Setup) -> Vec<Vec<u8>> {
    [90, 10].map(|quality| encode_jpeg(&frame(), quality).expect("it can be encoded")).into()
}

fn picture(_: &Setup) -> Read {
    Box::new(|bytes| decode_image(bytes, "attack", 0).map(drop).map_err(words_of))
}

/// Gives every block of a PNG the checksum it should have, as far as its blocks can be followed.
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

fn configs(setup: &Setup) -> Vec<Vec<u8>> {
    let tiny = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/tiny.toml");
    vec![read(&tiny), read(&setup.run().join("config.toml"))]
}

fn config(setup: &Setup) -> Read {
    file(setup, "config.toml", |path| read_checked_config(path, &[], Config::validate).map(drop).map_err(words_of))
}

fn model_weights(setup: &Setup) -> Read {
    let model = setup.model();
    file(setup, "model.safetensors", move |path| {
        let loaded = load_part(&mut model.clone(), &Clift::stage1_part(), path).map_err(words_of)?;
        loaded.require_all(path).map_err(words_of)
    })
}

/// Resumes from a checkpoint of which one file is damaged; its checksum is put right, or nothing behind it is reached.
fn checkpoint(setup: &Setup, name: &'static str) -> Read {
    let folder = setup.fresh(&format!("checkpoint-{name}"));
    let step = folder.join("step-000000002");
    std::fs::create_dir_all(&step).expect("a temporary folder is writable");
    for item in std::fs::read_dir(setup.checkpoint()).expect("the run has a checkpoint") {
        let path = item.expect("it can be listed").path();
        std::fs::copy(&path, step.join(path.file_name().expect("it has a name"))).expect("it can be copied");
    }
    let mut state: serde_json::Value =
        serde_json::from_slice(&read(&step.join("state.json"))).expect("a valid state is JSON");
    let model = setup.model();
    Box::new(move |bytes| {
        std::fs::write(step.join(name), bytes).expect("a temporary folder is writable");
        if name != "state.json" {
            state["files"][name] = serde_json::json!({"num_bytes": bytes.len(), "crc32": crc32fast::hash(bytes)});
            std::fs::write(step.join("state.json"), state.to_string()).expect("a temporary folder is writable");
        }
        let mut learner = TrainState {
            model: model.clone(),
            optimizer: adamw(&OptimizerConfig::default()),
            device: Device::flex().autodiff(),
            loss: Loss::default(),
            activation_checkpointing: false,
            loss_scale: None,
        };
        let checkpoints = Checkpoints::new(folder.clone(), CheckpointConfig::default());
        checkpoints.resume(&mut learner).map(drop).map_err(words_of)
    })
}

/// Reads every entry of a cluster cache of which one file is damaged.
fn clusters(setup: &Setup, name: &'static str) -> Read {
    let folder = setup.fresh(&format!("clusters-{name}"));
    for file in ["index.json", "clusters.bin"] {
        std::fs::copy(setup.run().join("clusters").join(file), folder.join(file)).expect("it can be copied");
    }
    let config = setup.config.clone();
    let index = String::from_utf8(read(&folder.join("index.json"))).expect("an index is text");
    let encoder =
        index.split("\"encoder\":\"").nth(1).and_then(|rest| rest.split('"').next()).unwrap_or_default().to_owned();
    Box::new(move |bytes| {
        std::fs::write(folder.join(name), bytes).expect("a temporary folder is writable");
        let cache = ClusterCache::open(&folder, &config, &encoder).map_err(words_of)?;
        for entry in cache.entries() {
            cache.read(entry).map_err(words_of)?;
        }
        Ok(())
    })
}

fn run_file(setup: &Setup) -> Read {
    let run = setup.fresh("run-file");
    let config = Config { run_dir: run.clone(), ..setup.config.clone() };
    Box::new(move |bytes| {
        std::fs::write(run.join("run.json"), bytes).expect("a temporary folder is writable");
        Run::reopen(config.clone()).map(drop).map_err(words_of)
    })
}
