//! `clift data poses` with a script in the place of COLMAP.

use std::os::unix::fs::PermissionsExt;
use std::process::{Child, Command};

use crate::support::{BINARY, Place, Ran, finish, repository, signal, start, wait_until};

/// Writes the options of COLMAP 3.8 and a small and a large model. `fail` and `wait` hold the command that fails or hangs.
const FAKE_COLMAP: &str = r#"#!/bin/sh
PATH=/usr/bin:/bin
here=$PWD
cd "$(dirname "$0")"
if [ "$1" = help ]; then exit; fi
if [ "$2" = -h ]; then
    echo "  --SiftExtraction.use_gpu arg (=1)"; echo "  --SiftMatching.use_gpu arg (=1)"
    echo "  --ImageReader.single_camera arg (=0)"
    exit
fi
echo "$@" >> calls
if [ "$(cat fail 2>/dev/null)" = "$1" ]; then echo "Check failed: no screen"; exit 6; fi
if [ "$(cat wait 2>/dev/null)" = "$1" ]; then touch waiting; exec sleep 600; fi
if [ "$1" = mapper ]; then
    while [ "$1" != --output_path ]; do shift; done
    out=$(cd "$here" && realpath "$2")
    mkdir "$out/0" "$out/1"
    printf '\2\0\0\0\0\0\0\0' > "$out/0/images.bin"
    cp MODEL/cameras.bin MODEL/images.bin "$out/1"
fi
"#;

/// Writes the script into `bin`, which is the PATH of a command then.
pub fn write_colmap(place: &Place) {
    let model = repository("data-fixtures/layouts/colmap_bin/attic/sparse/0");
    place.write("bin/colmap", FAKE_COLMAP.replace("MODEL", &model.display().to_string()).as_bytes());
    std::fs::set_permissions(place.at("bin/colmap"), std::fs::Permissions::from_mode(0o755)).unwrap();
}

fn with_colmap() -> Place {
    let place = Place::new();
    write_colmap(&place);
    place
}

fn start_poses(place: &Place, photos: &str) -> Child {
    let photos = repository("data-fixtures/layouts").join(photos);
    let mut command = Command::new(BINARY);
    command.args(["data", "poses"]).arg(photos).arg("-o").arg(place.at("attic"));
    start(command.env("PATH", place.at("bin")))
}

fn poses(place: &Place) -> Ran {
    finish(start_poses(place, "colmap_bin/attic/images"))
}

#[test]
fn the_largest_model_is_kept_and_checked() {
    let place = with_colmap();
    let ran = poses(&place).ok().prints("6 of 6 photos have a pose, in the largest of 2 models").prints("1 scene, ");
    let attic = place.at("attic");
    let next = format!("next:\n  clift encode {} -o attic.clift\n  clift view attic.clift\n", attic.display());
    assert!(ran.stdout.ends_with(&next), "{}", ran.stdout);
    assert_eq!(place.names("attic"), ["colmap", "images", "sparse"]);
    assert_eq!(place.names("attic/colmap"), ["log.txt", "origin.json"]);
    let calls = place.text("bin/calls");
    let [features, matches, mapper] = calls.lines().collect::<Vec<_>>()[..] else { panic!("{calls}") };
    assert!(features.ends_with("--ImageReader.single_camera 1 --SiftExtraction.use_gpu 0"), "{features}");
    assert!(matches.starts_with("exhaustive_matcher ") && matches.ends_with("--SiftMatching.use_gpu 0"), "{matches}");
    assert!(mapper.starts_with("mapper --image_path "), "{mapper}");
    poses(&place).ok().notes("the capture is complete; it is only checked").prints("next:");
    assert_eq!(place.text("bin/calls"), calls);
    let other = finish(start_poses(&place, "capture/attic/images"));
    other.fails_with(2, &["attic was begun with", "choose another folder"]);
}

#[test]
fn missing_programs_are_named_with_their_packages() {
    let place = Place::new();
    let message = poses(&place).fails_with(1, &["`colmap` is not on the PATH; install it: the package colmap"]);
    assert!(!place.at("attic").exists(), "{message}");
    let film = finish(start_poses(&with_colmap(), "capture/attic/transforms.json"));
    film.fails_with(1, &["`ffmpeg` is not on the PATH; install it: the package ffmpeg"]);
}

#[test]
fn the_same_command_continues_after_a_failure_and_a_signal() {
    let place = with_colmap();
    place.write("bin/fail", b"exhaustive_matcher");
    poses(&place).fails_with(1, &["colmap ended with exit status: 6", "Check failed: no screen", "log.txt"]);
    std::fs::remove_file(place.at("bin/fail")).unwrap();
    place.write("bin/wait", b"mapper");
    let mut child = start_poses(&place, "colmap_bin/attic/images");
    wait_until(&mut child, "the mapper", || place.at("bin/waiting").exists());
    signal(&child, "-INT");
    finish(child).fails_with(130, &["interrupted; the same command continues"]);
    assert_eq!(place.names("attic/images/left").len(), 6);
    assert!(!place.at("attic/sparse").exists());
    std::fs::remove_file(place.at("bin/wait")).unwrap();
    poses(&place).ok().prints("6 of 6 photos have a pose");
    assert_eq!(place.names("attic/colmap"), ["log.txt", "origin.json"]);
}
