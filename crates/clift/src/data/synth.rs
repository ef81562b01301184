//! `clift data synth`.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context;
use clift_data::{Encoding, Split, SyntheticConfig, SyntheticSource, write_evaluation_index, write_source};
use clift_eval::EvalConfig;
use clift_train::document::parse_config;

use super::args::{Splits, SynthArgs};
use super::text::{bytes, count};
use crate::WrongUsage;
use crate::terminal::Counter;

/// Scenes of a split where the user does not say.
const NUM_SCENES: usize = 100;

const INDEX: &str = "evaluation_index.json";

/// Writes the scenes and prints how to train on them.
pub fn run(args: &SynthArgs) -> anyhow::Result<()> {
    let config = config(args)?;
    refuse_existing(&args.out, args.split)?;
    let encoding = args.quality.map_or(Encoding::Png, Encoding::Jpeg);
    for &split in args.split.list() {
        write_split(args, &config, split, encoding)?;
    }
    let present = |split: Split| args.out.join(split.to_string()).join("index.json").exists();
    for split in [Split::Train, Split::Test].into_iter().filter(|split| !present(*split)) {
        println!("no {split} split yet; training needs both: clift data synth {} --split {split}", args.out.display());
    }
    if config.num_frames < 2 {
        println!("scenes of one frame cannot be trained on: no lines for a config");
        return Ok(());
    }
    let root = std::path::absolute(&args.out).context("finding the folder's full path")?;
    println!("\nLines for a config:\n\n{}", snippet(&config, &root));
    Ok(())
}

/// Writes one split, and the index of the test split.
fn write_split(args: &SynthArgs, config: &SyntheticConfig, split: Split, encoding: Encoding) -> anyhow::Result<()> {
    let source = SyntheticSource::new(SyntheticConfig { split, ..config.clone() })?;
    let folder = args.out.join(split.to_string());
    let started = Instant::now();
    let mut counter = Counter::new(&split.to_string(), config.num_scenes as u64);
    let written = write_source(&source, &folder, encoding, args.chunk_mb * 1_000_000, |done| counter.set(done as u64))?;
    drop(counter);
    let (scenes, frames) = (count(written.num_scenes, "scene"), count(config.num_frames, "frame"));
    let size = format!("{}x{}", config.width, config.height);
    let (bytes, seconds) = (bytes(written.image_bytes), started.elapsed().as_secs_f64());
    println!("{split}: {scenes} of {frames}, {size}, {bytes} in {seconds:.1} s: {}", folder.display());
    if split == Split::Test {
        let EvalConfig { num_context, num_targets, .. } = EvalConfig::default();
        let path = args.out.join(INDEX);
        if write_evaluation_index(&path, &source, num_context, num_targets)? == 0 {
            let needed = num_context + num_targets;
            println!("warning: the index has no views: {frames} are fewer than its {needed}; use --frames {needed}");
        }
        println!("index: {num_context} contexts and {num_targets} targets per scene: {}", path.display());
    }
    Ok(())
}

/// What the options and `--set` ask for.
fn config(args: &SynthArgs) -> anyhow::Result<SyntheticConfig> {
    let [width, height] = args.size.map_or([None; 2], |size| size.map(Some));
    let options = [("num_frames", args.frames), ("width", width), ("height", height)];
    let options = options.into_iter().filter_map(|(key, value)| Some(format!("{key}={}", value?)));
    let mut overrides = vec![format!("num_scenes={}", args.scenes.unwrap_or(NUM_SCENES))];
    overrides.extend(options);
    overrides.extend(args.seed.map(|seed| format!("seed={seed}")));
    overrides.extend(args.set.iter().cloned());
    let (config, changed) = parse_config::<SyntheticConfig>(Path::new("--set"), "", &overrides)?;
    if changed.iter().any(|change| change.key == "split") {
        return Err(WrongUsage("choose the split with --split, not with --set split".into()).into());
    }
    config.validate()?;
    Ok(config)
}

/// Nothing that exists is written over, and nothing is mixed in: `out` may hold the other split, and its index.
fn refuse_existing(out: &Path, splits: Splits) -> anyhow::Result<()> {
    if !out.exists() {
        return Ok(());
    }
    let mut allowed = Vec::new();
    match splits {
        Splits::Train => allowed.extend(["test".to_owned(), INDEX.to_owned()]),
        Splits::Test => allowed.push("train".to_owned()),
        Splits::Both => {}
    }
    let folder = std::fs::read_dir(out).with_context(|| format!("opening {}", out.display()))?;
    for entry in folder {
        let path: PathBuf = entry.with_context(|| format!("reading {}", out.display()))?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        if !allowed.iter().any(|allowed| *allowed == name) {
            let message = "is there already, and nothing is written over; choose another folder or move it away";
            return Err(WrongUsage(format!("{} {message}", path.display())).into());
        }
    }
    Ok(())
}

/// The part of a config that trains and evaluates on what was written.
fn snippet(config: &SyntheticConfig, root: &Path) -> String {
    let quoted = |path: &Path| toml::Value::String(path.to_string_lossy().into_owned()).to_string();
    let &SyntheticConfig { width, height, num_frames, .. } = config;
    let last = num_frames.saturating_sub(1);
    let num_context = last.clamp(2, 4);
    let first = (last * 3 / 5).max(num_context - 1);
    let (root, index) = (quoted(root), quoted(&root.join(INDEX)));
    format!(
        "[data]
source = \"chunks\"
root = {root}
width = {width}
height = {height}

[data.views]
min_context = {num_context}
max_context = {num_context}
min_gap = [{first}, {first}]
max_gap = [{last}, {last}]
warm_up_steps = 0
num_targets = 3

[eval]
index = {index}"
    )
}

#[cfg(test)]
mod tests {
    use clift_train::Config;

    use super::*;

    fn args(set: &[&str]) -> SynthArgs {
        SynthArgs {
            out: "out".into(),
            scenes: Some(3),
            frames: None,
            size: Some([16, 8]),
            seed: None,
            split: Splits::Both,
            set: set.iter().map(|text| (*text).to_owned()).collect(),
            chunk_mb: 100,
            quality: None,
        }
    }

    #[test]
    fn options_become_keys_and_set_wins_over_them() {
        let config = config(&args(&["width=24", "specular=0.9"])).unwrap();
        assert_eq!((config.num_scenes, config.width, config.height, config.specular), (3, 24, 8, 0.9));
        assert_eq!(config.num_frames, SyntheticConfig::default().num_frames);
    }

    #[test]
    fn wrong_keys_and_values_are_wrong_usage() {
        for set in ["widht=24", "fov_deg=200", "split=\"test\""] {
            let error = config(&args(&[set])).unwrap_err();
            assert_eq!(crate::exit_code(&error), crate::WRONG_USAGE, "{set}: {error}");
        }
    }

    #[test]
    fn the_printed_lines_are_a_valid_config_for_any_number_of_frames_that_can_train() {
        for num_frames in [2, 3, 4, 5, 16, 200] {
            let config = SyntheticConfig { num_frames, ..Default::default() };
            let lines = snippet(&config, Path::new("/data/a \"room\""));
            let file = format!("run_dir = \"run\"\n{lines}\n[stage1]\n[stage2]\n");
            let (config, _) = parse_config::<Config>(Path::new("a.toml"), &file, &[]).unwrap();
            config.validate().unwrap_or_else(|error| panic!("{num_frames} frames: {error}\n{lines}"));
            assert_eq!(config.data.root.as_deref(), Some(Path::new("/data/a \"room\"")));
            assert!(config.data.views.max_gap[1] < num_frames);
        }
    }

    #[test]
    fn a_folder_with_anything_but_the_other_split_is_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let refused = |splits| refuse_existing(folder.path(), splits).err().map(|error| error.to_string());
        assert_eq!(refused(Splits::Both), None);
        std::fs::create_dir(folder.path().join("train")).unwrap();
        assert_eq!(refused(Splits::Test), None);
        assert!(refused(Splits::Both).unwrap().contains("train is there already"));
        std::fs::write(folder.path().join("notes.txt"), "").unwrap();
        assert!(refused(Splits::Test).unwrap().contains("notes.txt is there already"));
        assert_eq!(refuse_existing(&folder.path().join("new"), Splits::Both).ok(), Some(()));
    }
}
