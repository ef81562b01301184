//! Every command of the README, the guides and the help texts runs as it is printed, with small settings on small data.

use std::collections::BTreeSet;
use std::path::Path;
use std::process::Command;

use serde_json::json;

use crate::data::poses::write_colmap;
use crate::evaluation::checkpoints::write_first_stage;
use crate::evaluation::eval::write_vgg;
use crate::support::{BINARY, Place, copy_folder, finish, repository, sources, start};
use crate::viewer::tab::Viewer;

/// Words of the documents, and those for small data.
const SMALLER: [(&str, &str); 6] = [
    (" /data/", " data/"),
    ("--scene KEY", "--scene 00000000000000b1"),
    ("--distance 45..135", "--distance 6..7"),
    ("--distance 6..20 --context 4 --targets 6", "--distance 2..6 --context 2 --targets 1"),
    ("--stored-tokens 256", "--stored-tokens 2"),
    ("--preset patchwise", "--preset patchwise --stored-tokens 1/2"),
];

/// Keys of a config whose training takes a second on six frames.
const SMALL_RUN: &str = "\
    run_dir=trained; data.width=16; data.height=16; data.synthetic.num_scenes=4; data.filters.min_frames=6; \
    data.views={min_context=2, max_context=2, min_gap=[3, 3], max_gap=[5, 5], warm_up_steps=0, num_targets=2}; \
    model.dim=16; model.num_heads=2; model.feed_forward_dim=24; model.num_encoder_blocks=1; \
    model.num_renderer_blocks=1; clusters.grid=[0.5]; clusters.num_scenes=2; clusters.num_passes=1; \
    stage1.further_sizes=[]; stage1.batch_size=2; stage1.accumulate=1; stage2.batch_size=2; stage2.accumulate=1; \
    eval.stored_tokens=[0.5]; eval.validation_stored_tokens=0.5; eval.num_scenes=1; eval.num_context=2; \
    eval.num_targets=2; eval.every=0";

/// The same as a layout of two views, for the micro run.
const SMALL_DATA: &str = "data={source='auto', root='PATH', width=16, height=16, views={min_context=2, max_context=2, \
    min_gap=[3, 3], max_gap=[5, 5], warm_up_steps=0, num_targets=2}}";

#[test]
fn every_documented_command_runs() {
    let mut documents = sources(&["docs/guide"], &["md"]);
    documents.insert("README.md".into(), std::fs::read_to_string(repository("README.md")).expect("README.md"));
    let mut help = String::new();
    add_help(&[], &mut help);
    documents.insert("clift --help".into(), format!("```\n{help}```\n"));
    let place = Place::new();
    let base = place.at("base");
    prepare(&base);
    write_colmap(&place);
    let (mut failures, mut names, mut count) = (Vec::new(), BTreeSet::new(), 0);
    for (i, (document, text)) in documents.iter().enumerate() {
        let folder = place.at(&format!("document-{i}"));
        copy_folder(&base, &folder);
        for line in commands(text) {
            let mut args = shlex::split(&line).unwrap_or_else(|| panic!("{document}: no shell command: {line}"));
            args.remove(0);
            if let Some(end) = args.iter().position(|arg| arg == ">") {
                args.truncate(end);
            }
            names.insert(args[0].clone());
            make_room(&folder, &args);
            shrink(&mut args);
            count += 1;
            if args[0] == "view" {
                // It serves without end; `Viewer` reads its first line, the URL.
                let words: Vec<&str> = args[1..].iter().map(String::as_str).collect();
                drop(Viewer::start(&words, &folder));
                continue;
            }
            let mut command = Command::new(BINARY);
            if args.starts_with(&["data".into(), "poses".into()]) {
                command.env("PATH", place.at("bin"));
            }
            let ran = finish(start(command.args(&args).current_dir(&folder)));
            if args[0] == "import" {
                take_small_images(&folder, &args);
            }
            // A check with a flagged scene is a result.
            let is_flagged =
                args.starts_with(&["data".into(), "check".into()]) && ran.code == Some(1) && !ran.stdout.is_empty();
            if ran.code != Some(0) && !is_flagged {
                failures.push(format!("{document}: {line}\n  ran {args:?}\n{}", ran.stderr));
            }
        }
    }
    assert!(failures.is_empty(), "{} of {count} commands fail:\n{}", failures.len(), failures.join("\n"));
    let expected = "codec compare data doctor encode eval export flops import metrics plan render train view";
    assert_eq!(names.into_iter().collect::<Vec<_>>().join(" "), expected, "commands with an example");
}

/// Appends the help texts of a command and its subcommands.
fn add_help(command: &[String], help: &mut String) {
    let output = finish(start(Command::new(BINARY).args(command).arg("--help").env("COLUMNS", "400"))).ok().stdout;
    let listed = output.split("\nCommands:\n").nth(1).unwrap_or_default().lines().take_while(|line| !line.is_empty());
    let names: Vec<String> =
        listed.filter_map(|line| line.strip_prefix("  ")?.split(' ').next().map(Into::into)).collect();
    for name in names.into_iter().filter(|name| !name.is_empty() && name != "help") {
        add_help(&[command, &[name]].concat(), help);
    }
    help.push_str(&output);
}

/// The commands in the code blocks of a document, without optional arguments that are placeholders.
fn commands(text: &str) -> Vec<String> {
    let (mut found, mut is_code, mut open) = (Vec::new(), false, None::<String>);
    for line in text.lines().map(str::trim) {
        if line.starts_with("```") {
            is_code = !is_code;
            continue;
        }
        // A column of an output begins with the name and two spaces.
        let is_command = line.starts_with("clift ") && !line.starts_with("clift  ");
        let Some(line) = (match open.take() {
            Some(begun) => Some(begun + line),
            None => (is_code && is_command).then(|| line.to_owned()),
        }) else {
            continue;
        };
        match line.strip_suffix('\\') {
            Some(begun) => open = Some(begun.to_owned()),
            // The others are forms: clift train [OPTIONS] <CONFIG>.
            None if !line.contains("[OPTIONS]") && !line.contains('<') => found.push(smaller(&line)),
            None => {}
        }
    }
    found
}

fn smaller(line: &str) -> String {
    let mut line = SMALLER.iter().fold(line.to_owned(), |line, (from, to)| line.replace(from, to));
    // [--seed 123] is an option, [--split S] has a placeholder.
    while let Some((before, rest)) = line.split_once(" [--") {
        let (option, after) = rest.split_once(']').expect("a closing bracket");
        let has_placeholder = option.ends_with(|last: char| last.is_ascii_uppercase());
        let option = if has_placeholder { String::new() } else { format!(" --{option}") };
        line = format!("{before}{option}{after}");
    }
    line
}

/// Removes what an earlier example wrote where this one writes. Evaluations of runs stay: a user has them, too.
fn make_room(folder: &Path, args: &[String]) {
    let is_output = |flag: &str| ["-o", "--out", "--json", "--csv"].contains(&flag);
    let flags = args.windows(2).filter(|pair| is_output(&pair[0])).map(|pair| &pair[1]);
    let positional = args.get(2).filter(|_| args.starts_with(&["data".into(), "synth".into()]));
    for path in flags.chain(positional) {
        let path = folder.join(path);
        drop(if path.is_dir() { std::fs::remove_dir_all(path) } else { std::fs::remove_file(path) });
    }
    drop(std::fs::remove_dir_all(folder.join("trained")));
}

/// Makes an imported model one of small images, as the fixtures have.
fn take_small_images(folder: &Path, args: &[String]) {
    let Some(pair) = args.windows(2).find(|pair| pair[0] == "-o") else { return };
    let path = folder.join(&pair[1]).join("config.toml");
    let Ok(config) = std::fs::read_to_string(&path) else { return };
    let config = config.replace("width = 448", "width = 24").replace("width = 256", "width = 24");
    std::fs::write(path, config.replace("height = 256", "height = 16")).expect("writable");
}

/// Adds small settings.
fn shrink(args: &mut Vec<String>) {
    let command = args[0].clone();
    let set = |args: &mut Vec<String>, keys: &[&str]| {
        args.extend(keys.iter().flat_map(|key| ["--set".to_owned(), (*key).to_owned()]));
    };
    let default = |args: &mut Vec<String>, flag: &str, value: &str| match args.iter().position(|arg| arg == flag) {
        Some(at) => value.clone_into(&mut args[at + 1]),
        None => args.extend([flag.to_owned(), value.to_owned()]),
    };
    let small_run: Vec<_> = SMALL_RUN.split("; ").collect();
    match (command.as_str(), args.get(1).map(String::as_str)) {
        ("train", _) => {
            default(args, "--device", "flex");
            // Each of several configs keeps its own `run_dir`, the first key.
            let several = args.iter().filter(|arg| arg.starts_with("configs/")).count() > 1;
            args.extend(several.then(|| "--fresh".to_owned()));
            set(args, &small_run[usize::from(several)..]);
            set(args, &["loss.perceptual_weight=0", "stage1.steps=1", "stage2.steps=1"]);
        }
        ("plan", _) => set(args, &small_run),
        ("eval", _) if args.iter().any(|arg| arg == "--checkpoint") => {
            set(args, &["data.width=24", "data.height=16"]);
        }
        ("codec", Some("models/re10k")) => {
            // The scenes of re10k-mini are short.
            args.retain(|arg| arg != "--set" && arg != "eval.num_context=4");
            set(args, &["eval.num_context=2"]);
        }
        ("import", _) => default(args, "--num-heads", "3"),
        ("render", _) if !args.iter().any(|arg| arg == "poses.json") => default(args, "--frames", "2"),
        ("view", _) => default(args, "--port", "0"),
        ("data", Some("synth")) => {
            default(args, "--scenes", "2");
            default(args, "--frames", "8");
            default(args, "--size", "32x32");
        }
        ("data", Some("poses")) => "photos".clone_into(&mut args[2]), // for a film too
        ("data", Some("index")) if !args.iter().any(|arg| arg == "--distance") => {
            args.extend(["--distance", "4..7", "--targets", "1"].map(str::to_owned));
        }
        _ => {}
    }
}

/// Makes the runs, models, data and files that the documents name.
fn prepare(base: &Path) {
    let fixture = |name: &str| repository("data-fixtures").join(name);
    let copy = |from: &Path, to: &str| {
        let to = base.join(to);
        std::fs::create_dir_all(to.parent().expect("a folder")).expect("writable");
        if from.is_dir() {
            copy_folder(from, &to);
        } else {
            std::fs::copy(from, to).expect("copies");
        }
    };
    copy(&repository("configs"), "configs");
    for name in ["PATH", "DIR", "data/re10k"] {
        copy(&fixture("re10k-mini"), name);
    }
    for name in ["captures/attic", "captures/fox"] {
        copy(&fixture("layouts/colmap_txt/attic"), name);
    }
    copy(&fixture("layouts/colmap_bin/attic/images"), "photos");
    copy(&fixture("layouts/dl3dv"), "DL3DV-ALL-480P");
    // A scene to train on beside that of the list of test scenes.
    let scene =
        std::fs::read_dir(fixture("layouts/dl3dv/1K")).expect("a folder").next().expect("a scene").expect("readable");
    let test_key = "f".repeat(64);
    copy(&scene.path(), &format!("DL3DV-ALL-480P/1K/{test_key}"));

    let index = fixture("re10k-mini/evaluation_index.json");
    for name in ["evaluation_index_re10k_context4", "evaluation_index_re10k_video_context4_data_100", "INDEX"] {
        copy(&index, &format!("{name}.json"));
    }
    copy(&index, "PATH/evaluation_index_re10k_context4.json");
    let mut dl3dv: serde_json::Value = serde_json::from_slice(&std::fs::read(&index).expect("an index")).expect("JSON");
    // `runs/dl3dv` has the scene of re10k-mini, the data the other.
    dl3dv[&test_key] = json!({"context": [0, 5], "target": [2]});
    std::fs::write(base.join("dl3dv_start_0_distance_50_ctx_4v_video_0_50.json"), dl3dv.to_string()).expect("writable");
    let pose = json!({"c2w": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]});
    std::fs::write(base.join("poses.json"), json!({"poses": [pose]}).to_string()).expect("writable");
    write_vgg(&base.join("lpips-vgg.safetensors"), "clift-lpips-vgg-1", [2, 2, 3, 3, 3], true);

    for name in ["second_stage.ckpt", "last.ckpt"] {
        copy(&fixture("checkpoints/re10k.ckpt"), name);
    }
    write_first_stage(&base.join("first_stage.ckpt"));

    let clift = |args: &[&str]| drop(finish(start(Command::new(BINARY).args(args).current_dir(base))).ok());
    let config = repository("tests/micro.toml").display().to_string();
    let train = |keys: &[&str]| {
        let sets = keys.iter().flat_map(|&key| ["--set", key]);
        clift(&["train", config.as_str()].into_iter().chain(sets).collect::<Vec<_>>());
    };
    train(&["run_dir=runs/tiny", "eval.formats=['f32', 'f16']"]);
    let tiles = ["run_dir=runs/tiny-tiles", "clusters.grouping='tile'", "eval.validation_stored_tokens=0.5"];
    train(&[&tiles[..], &["stage1={init_from='runs/tiny', steps=0}"]].concat());
    train(&["run_dir=runs/re10k", SMALL_DATA]);
    // An example replaces PATH.
    train(&["run_dir=runs/dl3dv", &SMALL_DATA.replace("PATH", "DIR")]);
    for count in [64, 16] {
        let (run_dir, latents) = (format!("run_dir=runs/lvsm-{count}"), format!("model.num_latents={count}"));
        let lvsm = ["model.architecture='lvsm-ed'", "model.condenser={num_blocks=0}", "stage1.keep_tokens=[1.0,1.0]"];
        train(&[&lvsm[..], &[run_dir.as_str(), latents.as_str()]].concat());
    }
    clift(&["import", "last.ckpt", "--variant", "released-re10k", "--num-heads", "3", "-o", "models/re10k"]);
    take_small_images(base, &["-o".into(), "models/re10k".into()]);
    let rooms = ["train", "configs/rooms-64.toml", "configs/rooms-128.toml", "configs/rooms.toml"];
    let mut rooms = rooms.map(str::to_owned).to_vec();
    shrink(&mut rooms);
    clift(&rooms.iter().map(String::as_str).collect::<Vec<_>>());
    for (from, to) in [("tiny", "a"), ("tiny", "b"), ("tiny", "tiny-570"), ("rooms", "capture"), ("rooms", "attic")] {
        copy(&base.join("runs").join(from), &format!("runs/{to}"));
    }
    clift(&["export", "runs/rooms", "-o", "models/rooms"]);
    clift(&["encode", "runs/tiny", "--scene", "synthetic-0-test-00000", "-o", "room.clift"]);
}
