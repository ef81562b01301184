//! Every example of the crates runs.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::support::{BINARY, finish, repository, start};

/// The examples with their arguments and a part of their output. `REPO` is the repository, `DIR` a temporary folder, `image`
/// a photo. An example may read what one before it wrote.
const EXAMPLES: [(&str, &[&str], &str); 6] = [
    ("custom_source", &[], "wall: 3 context views, 1 target view"),
    ("fit_frame", &["16x16", "image", "DIR/fitted.png"], ""),
    ("synthetic_sheet", &["DIR/sheet.png"], "us per frame of 64 x 64"),
    ("custom_loss", &[], "step 20: loss "),
    ("encode_and_render", &["REPO/models/rooms", "REPO/data-fixtures/layouts/colmap_txt/attic", "DIR/attic"], " dB"),
    ("read_scene", &["DIR/attic.clift"], "context views of 64 x 64"),
];
const IMAGE: &str = "data-fixtures/layouts/colmap_bin/attic/images/left/frame 9.png";
const WRITTEN: [&str; 4] = ["fitted.png", "sheet.png", "attic.clift", "attic.png"];

#[test]
fn every_example_runs() {
    let listed: BTreeSet<String> = EXAMPLES.iter().map(|(name, ..)| (*name).to_owned()).collect();
    assert_eq!(names(), listed, "EXAMPLES lists every example");
    let built = Path::new(BINARY).parent().expect("a folder").join("examples");
    let folder = tempfile::tempdir().expect("a temporary folder");
    for (name, words, expected) in EXAMPLES {
        let binary = built.join(format!("{name}{}", std::env::consts::EXE_SUFFIX));
        assert!(binary.is_file(), "{}: `cargo test --release --workspace` builds it", binary.display());
        let argument = |word: &&str| match *word {
            "image" => repository(IMAGE),
            word => match word.split_once('/') {
                Some(("REPO", path)) => repository(path),
                Some(("DIR", path)) => folder.path().join(path),
                _ => PathBuf::from(word),
            },
        };
        finish(start(Command::new(binary).args(words.iter().map(argument)))).ok().prints(expected);
    }
    for name in WRITTEN {
        let size = folder.path().join(name).metadata().map(|file| file.len());
        assert!(size.is_ok_and(|size| size > 0), "{name} is written");
    }
}

/// Returns the names of all examples in the sources.
fn names() -> BTreeSet<String> {
    let crates = std::fs::read_dir(repository("crates")).expect("crates");
    let folders = crates.map(|item| item.expect("readable").path().join("examples")).filter(|folder| folder.is_dir());
    let files = folders.flat_map(|folder| std::fs::read_dir(folder).expect("readable"));
    let names = files.map(|file| file.expect("readable").path());
    names.filter_map(|path| Some(path.file_stem()?.to_str()?.to_owned())).collect()
}
