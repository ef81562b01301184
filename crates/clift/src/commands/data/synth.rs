//! `clift data synth`.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context;
use clift_data::{
    ChunkSource, EvaluationIndex, ImageEncoding, SceneFilters, SceneSource, Split, SyntheticConfig, SyntheticSource,
    write_evaluation_index, write_source,
};
use clift_eval::EvalConfig;
use clift_model::ModelConfig;
use clift_train::parse_config;

use crate::commands::data::text::{bytes, count};
use crate::commands::parse::parse_size;
use crate::commands::splits::Splits;
use crate::exit_code::UsageError;
use crate::output::counter::Counter;
use crate::output::stdout::{print_note, print_result};

/// Fewest frames to train on and to measure: two contexts and a target that is neither.
const MIN_FRAMES: usize = 3;

/// Scenes of a split where the user does not say.
const NUM_SCENES: usize = 100;

const INDEX: &str = "evaluation_index.json";

/// Writes the scenes and prints how to train on them.
pub fn run(args: &SynthArgs) -> anyhow::Result<()> {
    let config = config(args)?;
    refuse_existing(&args.out, args.split)?;
    refuse_another_size(&args.out, args.split, &config)?;
    let (size, [width, height]) = ([config.width, config.height], cropped(&config));
    if size != [width, height] && width > 0 && height > 0 {
        let (size, patch) = (format!("{}x{}", size[0], size[1]), patch_size());
        print_note(&format!(
            "warning: {size} is not made of patches of {patch}x{patch}: to be cropped to {width}x{height}"
        ));
    }
    let encoding = args.quality.map_or(ImageEncoding::Png, ImageEncoding::Jpeg);
    for &split in args.split.list() {
        write_split(args, &config, split, encoding)?;
    }
    let present = |split: Split| args.out.join(split.to_string()).join("index.json").exists();
    for split in [Split::Train, Split::Test].into_iter().filter(|split| !present(*split)) {
        let out = args.out.display();
        print_result(&format!("no {split} split yet; training needs both: clift data synth {out} --split {split}"))?;
    }
    let root = std::path::absolute(&args.out).context("finding the folder's full path")?;
    match snippet(&config, &root, has_views(&root.join(INDEX))) {
        Ok(lines) => print_result(&format!("\nLines for a config:\n\n{lines}")),
        Err(reason) => print_result(&format!("no lines for a config: {reason}")),
    }
}

/// Writes one split, and the index of the test split.
fn write_split(
    args: &SynthArgs,
    config: &SyntheticConfig,
    split: Split,
    encoding: ImageEncoding,
) -> anyhow::Result<()> {
    let source = SyntheticSource::new(SyntheticConfig { split, ..config.clone() })?;
    let folder = args.out.join(split.to_string());
    let started = Instant::now();
    let mut counter = Counter::new(&split.to_string(), config.num_scenes as u64);
    let written = write_source(&source, &folder, encoding, args.chunk_mb * 1_000_000, |done| counter.set(done as u64))?;
    drop(counter);
    let (scenes, frames) = (count(written.num_scenes, "scene"), count(config.num_frames, "frame"));
    let size = format!("{}x{}", config.width, config.height);
    let (bytes, seconds) = (bytes(written.image_bytes), started.elapsed().as_secs_f64());
    print_result(&format!("{split}: {scenes} of {frames}, {size}, {bytes} in {seconds:.1} s: {}", folder.display()))?;
    if split == Split::Test {
        let EvalConfig { num_context, num_targets, .. } = EvalConfig::default();
        let path = args.out.join(INDEX);
        if write_evaluation_index(&path, &source, num_context, num_targets)? == 0 {
            let needed = num_context + num_targets;
            print_note(&format!("warning: the index has no views: {frames} are too few; use --frames {needed}"));
        } else {
            let path = path.display();
            print_result(&format!("index: {num_context} contexts and {num_targets} targets per scene: {path}"))?;
        }
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
        return Err(UsageError("choose the split with --split, not with --set split".into()).into());
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
            return Err(UsageError(format!("{} {message}", path.display())).into());
        }
    }
    Ok(())
}

/// The lines of a config are for both splits, so both must have scenes alike.
fn refuse_another_size(out: &Path, splits: Splits, config: &SyntheticConfig) -> anyhow::Result<()> {
    for split in [Split::Train, Split::Test].into_iter().filter(|split| !splits.list().contains(split)) {
        let folder = out.join(split.to_string());
        if !folder.join("index.json").exists() {
            continue;
        }
        let source = ChunkSource::open(out, split, &SceneFilters::default())?;
        if source.num_scenes() == 0 {
            continue;
        }
        let (picture, num_frames) = (source.frame(0, 0)?, source.num_frames(0)?);
        let text = |num_frames, width, height| format!("{}, {width}x{height}", count(num_frames, "frame"));
        let there = text(num_frames, picture.width, picture.height);
        let asked = text(config.num_frames, config.width, config.height);
        if there != asked {
            let message = format!("{} has scenes of {there}, not of {asked}", folder.display());
            return Err(UsageError(format!("{message}; write the same, or choose another folder")).into());
        }
    }
    Ok(())
}

/// Whether there is an evaluation index with views.
fn has_views(index: &Path) -> bool {
    EvaluationIndex::read(index).is_ok_and(|index| index.usable().next().is_some())
}

/// The patch of the model that a config has by default.
fn patch_size() -> usize {
    ModelConfig::default().patch_size
}

/// Columns and rows without what is left of a patch at the edges.
fn cropped(config: &SyntheticConfig) -> [usize; 2] {
    [config.width, config.height].map(|side| side / patch_size() * patch_size())
}

/// The part of a config that trains and evaluates on what was written, or why there is none.
fn snippet(config: &SyntheticConfig, root: &Path, has_index: bool) -> Result<String, String> {
    let quoted = |path: &Path| toml::Value::String(path.to_string_lossy().into_owned()).to_string();
    let num_frames = config.num_frames;
    if num_frames < MIN_FRAMES {
        return Err(format!("{} per scene, and training takes {MIN_FRAMES} or more", count(num_frames, "frame")));
    }
    let [width, height] = cropped(config);
    if width == 0 || height == 0 {
        return Err(format!("a picture is smaller than a patch of the model, {patch}x{patch}", patch = patch_size()));
    }
    let last = num_frames.saturating_sub(1);
    let num_context = last.clamp(2, 4);
    let first = (last * 3 / 5).max(num_context - 1);
    let defaults = EvalConfig::default();
    let eval = if has_index {
        format!("\n\n[eval]\nindex = {}", quoted(&root.join(INDEX)))
    } else if num_frames < defaults.num_context + defaults.num_targets {
        let num_targets = (num_frames - num_context).min(defaults.num_targets);
        format!("\n\n[eval]\nnum_context = {num_context}\nnum_targets = {num_targets}")
    } else {
        String::new()
    };
    let root = quoted(root);
    Ok(format!(
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
num_targets = 3{eval}"
    ))
}

/// Arguments of `clift data synth`.
#[derive(Debug, clap::Args)]
pub struct SynthArgs {
    /// Folder to write to; it may hold the other split, of the same size, and nothing else
    pub out: PathBuf,
    /// Scenes of each split [default: 100]
    #[arg(long, value_name = "N")]
    pub scenes: Option<usize>,
    /// Frames of each scene [default: 16]
    #[arg(long, value_name = "F")]
    pub frames: Option<usize>,
    /// Columns and rows of a frame [default: 32x32]
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    pub size: Option<[usize; 2]>,
    /// Seed of all scenes; no two seeds share one [default: 0]
    #[arg(long, value_name = "S")]
    pub seed: Option<u64>,
    /// Which scenes to write
    #[arg(long, value_enum, default_value_t = Splits::Both)]
    pub split: Splits,
    /// Change another key of the scenes; wins over the options above
    #[arg(long, value_name = "KEY=TOML")]
    pub set: Vec<String>,
    /// Size at which a chunk is closed, in megabytes of pictures
    #[arg(long, value_name = "M", default_value_t = 100, value_parser = clap::value_parser!(u64).range(1..=4000))]
    pub chunk_mb: u64,
    /// Store frames as JPEG of this quality, 1 to 100, instead of PNG (without loss)
    #[arg(long, value_name = "Q", value_parser = clap::value_parser!(u8).range(1..=100))]
    pub quality: Option<u8>,
}

#[cfg(test)]
mod tests {
    use clift_data::even_views;
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
            assert_eq!(crate::exit_code::exit_code(&error), crate::exit_code::WRONG_USAGE, "{set}: {error}");
        }
    }

    /// The config that the printed lines make.
    fn printed(num_frames: usize, size: [usize; 2], has_index: bool) -> Config {
        let config = SyntheticConfig { num_frames, width: size[0], height: size[1], ..Default::default() };
        let lines = snippet(&config, Path::new("/data/a \"room\""), has_index).unwrap();
        let file = format!("run_dir = \"run\"\n{lines}\n[stage1]\n[stage2]\n");
        let (config, _) = parse_config::<Config>(Path::new("a.toml"), &file, &[]).unwrap();
        config.validate().unwrap_or_else(|error| panic!("{num_frames} frames: {error}\n{lines}"));
        config
    }

    #[test]
    fn the_printed_lines_are_a_valid_config_for_any_number_of_frames_that_can_train() {
        for num_frames in [3, 4, 5, 6, 7, 16, 200] {
            let config = printed(num_frames, [32, 32], false);
            assert_eq!(config.data.root.as_deref(), Some(Path::new("/data/a \"room\"")));
            assert!(config.data.views.max_gap[1] < num_frames);
            assert_eq!(config.eval.index, None);
            let EvalConfig { num_context, num_targets, .. } = config.eval;
            assert!(even_views(num_frames, num_context, num_targets).is_some(), "{num_frames} frames");
        }
        let index = printed(16, [32, 32], true).eval.index;
        assert_eq!(index.as_deref(), Some(Path::new("/data/a \"room\"/evaluation_index.json")));
    }

    #[test]
    fn the_printed_lines_crop_to_whole_patches_and_say_why_there_are_none() {
        let cropped = printed(16, [36, 20], false);
        assert_eq!((cropped.data.width, cropped.data.height), (32, 16));
        let reason = |num_frames, width| {
            let config = SyntheticConfig { num_frames, width, ..Default::default() };
            snippet(&config, Path::new("out"), false).unwrap_err()
        };
        assert_eq!(reason(2, 32), "2 frames per scene, and training takes 3 or more");
        assert_eq!(reason(16, 7), "a picture is smaller than a patch of the model, 8x8");
    }

    #[test]
    fn an_index_counts_only_with_views_in_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(INDEX);
        assert!(!has_views(&path));
        std::fs::write(&path, r#"{"a": null}"#).unwrap();
        assert!(!has_views(&path));
        std::fs::write(&path, r#"{"a": {"context": [0, 2], "target": [1]}}"#).unwrap();
        assert!(has_views(&path));
    }

    #[test]
    fn a_split_beside_one_of_another_size_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let config = SyntheticConfig { num_scenes: 1, num_frames: 3, width: 16, height: 8, ..Default::default() };
        let source = SyntheticSource::new(config.clone()).unwrap();
        write_source(&source, &folder.path().join("train"), ImageEncoding::Png, 1, |_| ()).unwrap();
        let refused = |splits, config| refuse_another_size(folder.path(), splits, &config).err();
        assert!(refused(Splits::Test, config.clone()).is_none());
        for (other, asked) in [
            (SyntheticConfig { width: 24, ..config.clone() }, "3 frames, 24x8"),
            (SyntheticConfig { num_frames: 4, ..config.clone() }, "4 frames, 16x8"),
        ] {
            let error = refused(Splits::Test, other).unwrap();
            let expected = format!("train has scenes of 3 frames, 16x8, not of {asked}; write the same, or ");
            assert!(error.to_string().contains(&expected), "{error}");
            assert_eq!(crate::exit_code::exit_code(&error), crate::exit_code::WRONG_USAGE);
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
