//! The valid files that attacks start from: fixtures, and the files of a small run.

use std::error::Error;
use std::io::{Cursor, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use clift_model::Network;
use clift_train::{Config, read_config};
use tempfile::TempDir;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

pub struct Setup {
    folder: TempDir,
    pub config: Config,
}

impl Setup {
    pub fn make() -> Result<Self, Box<dyn Error>> {
        // In memory where possible: files are written once per execution.
        let memory = Path::new("/dev/shm");
        let folder = if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() }?;
        let place = |name: &str| folder.path().join(name);
        let run = place("run");
        let run_dir = format!("run_dir={:?}", text(&run));
        let micro = text(&Path::new(env!("CARGO_MANIFEST_DIR")).join("micro.toml"));
        clift(&["train", &micro, "--set", &run_dir])?;
        for storage in ["f32", "f16", "coded"] {
            let out = text(&place(&format!("room-{storage}.clift")));
            let scene = ["--scene", "synthetic-0-test-00000", "--format", storage, "-o", &out];
            clift(&[&["encode", &text(&run)], &scene[..]].concat())?;
        }
        let (config, _) = read_config(&run.join("config.toml"), &[])?;
        Ok(Self { folder, config })
    }

    pub fn at(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub fn fresh(&self, name: &str) -> PathBuf {
        let folder = self.folder.path().join("attack").join(name);
        std::fs::create_dir_all(&folder).expect("a temporary folder is writable");
        folder
    }

    /// The model of the run, with other weights.
    pub fn model(&self) -> Network {
        Network::new(&self.config.model, 1, &burn::tensor::Device::flex().autodiff())
    }
}

fn text(path: &Path) -> String {
    path.display().to_string()
}

/// Runs the command line beside this program.
fn clift(args: &[&str]) -> Result<(), Box<dyn Error>> {
    let program = std::env::current_exe()?.with_file_name("clift-under-test");
    let output = Command::new(program).args(args).stdin(Stdio::null()).output()?;
    if output.status.success() { Ok(()) } else { Err(String::from_utf8_lossy(&output.stderr).into()) }
}

pub fn fixtures() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../data-fixtures")
}

pub fn fixture(path: &str) -> Vec<u8> {
    read(&fixtures().join(path))
}

pub fn read(path: &Path) -> Vec<u8> {
    std::fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

pub fn write(path: &Path, bytes: &[u8]) {
    std::fs::write(path, bytes).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
}

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
    members(archive).into_iter().find(|(name, _)| name.ends_with(ending)).expect("it has such a member").1
}

fn members(archive: &[u8]) -> Vec<(String, Vec<u8>)> {
    let mut archive = ZipArchive::new(Cursor::new(archive)).expect("a valid archive");
    let members = (0..archive.len()).map(|i| {
        let (mut member, mut bytes) = (archive.by_index(i).expect("it is there"), Vec::new());
        member.read_to_end(&mut bytes).expect("it can be read");
        (member.name().expect("a name").into_owned(), bytes)
    });
    members.collect()
}

/// The archive with another pickle, and a checksum that fits it.
pub fn with_pickle(archive: &[u8], pickle: &[u8]) -> Vec<u8> {
    let mut writer = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    for (name, bytes) in members(archive) {
        writer.start_file(&name, options).expect("a new member");
        writer.write_all(if name.ends_with("data.pkl") { pickle } else { &bytes }).expect("memory is writable");
    }
    writer.finish().expect("memory is writable").into_inner()
}
