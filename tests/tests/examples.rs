//! Every example of the crates runs.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::support::{BINARY, Place, finish, repository, sources, start};

/// The examples with their arguments and a part of their output. `REPO` is the repository, `DIR` a temporary folder with the
/// photos of a scene. An example may read what one before it wrote.
const EXAMPLES: [(&str, &[&str], &str); 4] = [
    ("custom_source", &[], "wall: 3 context views, 1 target view"),
    ("synthetic_sheet", &["DIR/sheet.png"], ""),
    ("fit_frame", &["16x16", "DIR/sheet.png", "DIR/fitted.png"], ""),
    ("encode_and_render", &["REPO/models/rooms", "DIR/photos", "DIR/scene"], "the nearest context view"),
];
const WRITTEN: [&str; 4] = ["fitted.png", "sheet.png", "scene.clift", "scene.png"];

#[test]
fn every_example_runs() {
    let found = sources(&["crates"], &["rs"]).into_keys().filter_map(|path| {
        let (_, name) = path.split_once("/examples/")?;
        (!name.contains('/')).then(|| name.trim_end_matches(".rs").to_owned())
    });
    let listed = EXAMPLES.map(|(name, ..)| name.to_owned());
    assert_eq!(found.collect::<BTreeSet<_>>(), listed.into(), "EXAMPLES lists every example");
    let built = Path::new(BINARY).parent().expect("a folder").join("examples");
    let place = Place::new();
    place.clift("data synth DIR/photos --look real --scenes 1 --frames 16 --size 128x128").ok();
    for (name, words, expected) in EXAMPLES {
        let binary = built.join(format!("{name}{}", std::env::consts::EXE_SUFFIX));
        assert!(binary.is_file(), "{}: `cargo test --release --workspace` builds it", binary.display());
        let argument = |word: &&str| match word.split_once('/') {
            Some(("REPO", path)) => repository(path),
            Some(("DIR", path)) => place.at(path),
            _ => PathBuf::from(word),
        };
        finish(start(Command::new(binary).args(words.iter().map(argument)))).ok().prints(expected);
    }
    for name in WRITTEN {
        assert!(place.at(name).metadata().is_ok_and(|file| file.len() > 0), "{name} is written");
    }
}
