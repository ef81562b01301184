//! The readers, each with one damaged file.

use std::fmt::Display;
use std::path::Path;
use std::sync::atomic::AtomicBool;

use burn::tensor::Device;
use clift_core::RgbImage;
use clift_data::{
    ChunkSource, DatasetRoot, Pickle, SceneFilters, SceneSource, SourceOptions, Split, decode_image, encode_jpeg,
    encode_png, open_source,
};
use clift_model::{CliftVariant, Network, load_part};
use clift_train::{Checkpoints, ClusterCache, Config, OptimizerConfig, Run, TrainState, import};

use crate::setup::{Setup, copy_folder, fixture, fixtures, read, with_pickle, write};

/// Reads bytes to the end, or returns the error message.
pub type Read = Box<dyn FnMut(&[u8]) -> Result<(), String>>;

/// A chunk of two scenes.
pub const CHUNK: &str = "re10k-mini/train/000000.torch";
pub const CHUNK_INDEX: &str = "re10k-mini/train/index.json";

/// Drops a result, and turns its error into text.
pub fn done<T, E: Display>(result: Result<T, E>) -> Result<(), String> {
    result.map(drop).map_err(|error| error.to_string())
}

pub fn file(setup: &Setup, name: &str, read: impl Fn(&Path) -> Result<(), String> + 'static) -> Read {
    let path = setup.fresh(name).join(name);
    Box::new(move |bytes| {
        write(&path, bytes);
        read(&path)
    })
}

pub fn pickle() -> Read {
    Box::new(|bytes| done(Pickle::parse(bytes, Path::new("attack.pkl"))))
}

/// A folder of one chunk, of which `damaged` is made of the bytes.
fn chunks(setup: &Setup, damaged: &'static str, make: fn(&[u8]) -> Vec<u8>) -> Read {
    let root = setup.fresh(damaged);
    let place = move |file: &str| root.join(file.trim_start_matches("re10k-mini/"));
    std::fs::create_dir_all(place("train")).expect("a temporary folder is writable");
    for name in [CHUNK, CHUNK_INDEX] {
        write(&place(name), &fixture(name));
    }
    Box::new(move |bytes| {
        write(&place(damaged), &make(bytes));
        let open = || ChunkSource::open(&place(""), Split::Train, &SceneFilters::default());
        scenes(&open().map_err(|error| error.to_string())?)
    })
}

pub fn chunk(setup: &Setup, file: &'static str) -> Read {
    chunks(setup, file, <[u8]>::to_vec)
}

pub fn chunk_pickle(setup: &Setup) -> Read {
    chunks(setup, CHUNK, |bytes| with_pickle(&fixture(CHUNK), bytes))
}

/// Reads cameras and the first frames of every scene.
fn scenes(source: &dyn SceneSource) -> Result<(), String> {
    let read_scene = |scene| {
        source.cameras(scene)?;
        (0..source.num_frames(scene)?.min(3)).try_for_each(|frame| source.frame(scene, frame).map(drop))
    };
    done((0..source.num_scenes()).try_for_each(read_scene))
}

fn pattern() -> RgbImage {
    let rgb = (0..40 * 24 * 3).map(|i: usize| (i * 7 % 251) as u8).collect();
    RgbImage { width: 40, height: 24, rgb }
}

pub fn pngs() -> Vec<Vec<u8>> {
    vec![encode_png(&pattern()).expect("a valid image")]
}

pub fn jpegs() -> Vec<Vec<u8>> {
    [90, 10].map(|quality| encode_jpeg(&pattern(), quality).expect("a valid image")).into()
}

pub fn image() -> Read {
    Box::new(|bytes| done(decode_image(bytes, "attack", 0)))
}

pub fn weights(setup: &Setup) -> Read {
    let model = setup.model();
    file(setup, "model.safetensors", move |path| {
        let loaded = load_part(&mut model.clone(), &Network::stage1_part(), path).map_err(|error| error.to_string())?;
        done(loaded.require_all(path))
    })
}

/// Resumes from a checkpoint with one damaged file, whose checksum is corrected: otherwise no other check is reached.
pub fn checkpoint(setup: &Setup, name: &'static str) -> (Vec<Vec<u8>>, Read) {
    let folder = setup.fresh(&format!("checkpoint-{name}"));
    let step = folder.join("step-000000006");
    copy_folder(&setup.at("run/stage1/checkpoints/step-000000006"), &step);
    let mut state: serde_json::Value = serde_json::from_slice(&read(&step.join("state.json"))).expect("a valid state");
    let (valid, model) = (read(&step.join(name)), setup.model());
    let read = Box::new(move |bytes: &[u8]| {
        write(&step.join(name), bytes);
        if name != "state.json" {
            state["files"][name] = serde_json::json!({"num_bytes": bytes.len(), "crc32": crc32fast::hash(bytes)});
            write(&step.join("state.json"), state.to_string().as_bytes());
        }
        let mut train_state = TrainState::new(model.clone(), &OptimizerConfig::default(), Device::flex().autodiff());
        done(Checkpoints { folder: folder.clone(), model: None }.load(6, &mut train_state))
    });
    (vec![valid], read)
}

pub fn clusters(setup: &Setup, name: &'static str) -> Read {
    let folder = setup.fresh(&format!("clusters-{name}"));
    copy_folder(&setup.at("run/clusters"), &folder);
    let config = setup.config.clone();
    let index: serde_json::Value = serde_json::from_slice(&read(&folder.join("index.json"))).expect("a valid index");
    let encoder = index["encoder"].as_str().expect("a hash").to_owned();
    Box::new(move |bytes| {
        write(&folder.join(name), bytes);
        let cache = ClusterCache::open(&folder, &config, &encoder).map_err(|error| error.to_string())?;
        done(cache.entries().iter().try_for_each(|entry| cache.read(entry).map(drop)))
    })
}

pub fn run_file(setup: &Setup) -> Read {
    let run = setup.fresh("run-file");
    let config = Config { run_dir: run.clone(), ..setup.config.clone() };
    std::fs::copy(setup.config.run_dir.join("config.toml"), run.join("config.toml")).expect("a run has a config");
    Box::new(move |bytes| {
        write(&run.join("run.json"), bytes);
        done(Run::reopen(config.clone()))
    })
}

/// A copy of the data set that `path` is part of, with the file replaced.
pub fn layout(setup: &Setup, path: &str) -> (Vec<Vec<u8>>, Read) {
    let inside = path.splitn(3, '/').nth(2).expect("a file of a layout");
    let root = setup.fresh(&path.replace('/', "-"));
    copy_folder(&fixtures().join(path.trim_end_matches(inside)), &root);
    let file = root.join(inside);
    let read = Box::new(move |bytes: &[u8]| {
        write(&file, bytes);
        let opened = DatasetRoot::find(&root)
            .and_then(|root| open_source(&root, Split::Test, &SourceOptions::default(), &mut |_, _| ()));
        scenes(&*opened.map_err(|error| error.to_string())?.source)
    });
    (vec![fixture(path)], read)
}

pub fn published_checkpoint(setup: &Setup) -> Read {
    let folder = setup.fresh("published-checkpoint");
    let (file, out) = (folder.join("last.ckpt"), folder.join("model"));
    let network = (CliftVariant::ReleasedRe10k, Some(3));
    Box::new(move |bytes| {
        write(&file, bytes);
        let imported = done(import(&file, &out, network, &AtomicBool::new(false)));
        if imported.is_ok() {
            std::fs::remove_dir_all(&out).expect("a model was written");
        } else {
            assert!(!out.exists(), "a refused checkpoint leaves no files");
        }
        imported
    })
}
