//! The valid files that attacks start from: fixtures, and the files of a small run.

use std::io::{Cursor, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use clift_model::{Clift, TokenFormat};
use clift_train::{Config, read_config};
use tempfile::TempDir;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

/// The smallest run that has everything.
const RUN: &str = "\
seed = 0
data = { width = 16, height = 16, \
    synthetic = { num_scenes = 4, num_frames = 8, width = 16, height = 16, samples_per_pixel = 1 }, \
    views = { min_context = 2, max_context = 2, min_gap = [3, 3], max_gap = [6, 6], warm_up_steps = 0, num_targets = 2 } }
model = { dim = 16, num_heads = 2, feed_forward_dim = 24, num_encoder_blocks = 1, num_renderer_blocks = 1, \
    condenser = { num_blocks = 1 } }
stage1 = { steps = 2, batch_size = 1 }
clusters = { grid = [0.5, 1.0], num_passes = 1, num_scenes = 3 }
stage2 = { steps = 1, batch_size = 1 }
eval = { storage = [0.5], num_scenes = 1, num_context = 2, num_targets = 1, num_sheets = 0, num_validation_scenes = 1 }
";

/// A folder with a run, its scene files, and damaged copies.
pub struct Setup {
    folder: TempDir,
    /// The run's config.
    pub config: Config,
}

impl Setup {
    /// Trains the run and stores a scene of it with the command line.
    pub fn make() -> Result<Self, String> {
        // In memory where possible: files are written once per execution.
        let memory = Path::new("/dev/shm");
        let folder = if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() };
        let folder = folder.map_err(|error| error.to_string())?;
        let place = |name: &str| folder.path().join(name);
        let run = place("run");
        std::fs::write(place("run.toml"), format!("run_dir = {:?}\n{RUN}", run.display().to_string()))
            .map_err(|error| error.to_string())?;
        clift(&["train", &text(&place("run.toml"))])?;
        for storage in TokenFormat::ALL {
            let out = text(&place(&format!("room-{storage}.clift")));
            let scene = ["--scene", "synthetic-0-test-00000", "--tokens", storage.name(), "-o", &out];
            clift(&[&["encode", &text(&run)], &scene[..]].concat())?;
        }
        let (config, _) = read_config(&run.join("config.toml"), &[]).map_err(|error| error.to_string())?;
        Ok(Self { folder, config })
    }

    /// The run directory.
    pub fn run(&self) -> PathBuf {
        self.folder.path().join("run")
    }

    /// A file of the folder.
    pub fn at(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// A new folder for damaged files.
    pub fn fresh(&self, name: &str) -> PathBuf {
        let folder = self.folder.path().join("attack").join(name);
        std::fs::create_dir_all(&folder).expect("a temporary folder is writable");
        folder
    }

    /// The model of the run, with other weights.
    pub fn model(&self) -> Clift {
        Clift::new(&self.config.model, 1, &burn::tensor::Device::flex().autodiff())
    }

    /// The newest checkpoint of stage 1.
    pub fn checkpoint(&self) -> PathBuf {
        self.run().join("stage1/checkpoints/step-000000002")
    }
}

fn text(path: &Path) -> String {
    path.display().to_string()
}

/// Runs the command line beside this program.
fn clift(args: &[&str]) -> Result<(), String> {
    let program = std::env::current_exe().map_err(|error| error.to_string())?.with_file_name("clift-under-test");
    let output = Command::new(&program)
        .args(args)
        .stdin(Stdio::null())
        .output()
        .map_err(|error| format!("{}: {error}", program.display()))?;
    if output.status.success() { Ok(()) } else { Err(String::from_utf8_lossy(&output.stderr).into_owned()) }
}

/// The folder of the fixtures.
pub fn fixtures() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../data-fixtures")
}

/// Reads a fixture.
pub fn fixture(path: &str) -> Vec<u8> {
    read(&fixtures().join(path))
}

/// Reads a file that exists.
pub fn read(path: &Path) -> Vec<u8> {
    std::fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// Writes a file of a temporary folder.
pub fn write(path: &Path, bytes: &[u8]) {
    std::fs::write(path, bytes).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
}

/// Copies a folder with everything in it.
pub fn copy_folder(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).expect("a temporary folder is writable");
    for entry in std::fs::read_dir(from).expect("a folder") {
        let path = entry.expect("readable").path();
        let target = to.join(path.file_name().expect("named"));
        if path.is_dir() {
            copy_folder(&path, &target);
        } else {
            std::fs::copy(&path, &target).expect("readable");
        }
    }
}

/// A member of an archive of `torch.save`.
pub fn member(archive: &[u8], ending: &str) -> Vec<u8> {
    let mut archive = ZipArchive::new(Cursor::new(archive)).expect("a valid archive");
    let names: Vec<String> = archive.file_names().map(|name| name.expect("a name").into_owned()).collect();
    let name = names.iter().find(|name| name.ends_with(ending)).expect("it has such a member");
    let mut bytes = Vec::new();
    archive.by_name(name).expect("it is there").read_to_end(&mut bytes).expect("it can be read");
    bytes
}

/// The archive with another pickle, and a checksum that fits it.
pub fn with_pickle(archive: &[u8], pickle: &[u8]) -> Vec<u8> {
    let mut source = ZipArchive::new(Cursor::new(archive)).expect("a valid archive");
    let names: Vec<String> = source.file_names().map(|name| name.expect("a name").into_owned()).collect();
    let mut writer = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    for name in names {
        let mut bytes = Vec::new();
        source.by_name(&name).expect("it is there").read_to_end(&mut bytes).expect("it can be read");
        writer.start_file(&name, options).expect("a new member");
        writer.write_all(if name.ends_with("data.pkl") { pickle } else { &bytes }).expect("memory is writable");
    }
    writer.finish().expect("memory is writable").into_inner()
}
