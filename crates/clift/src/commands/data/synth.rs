//! `clift data synth`.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context;
use clift_core::{TEMPORARY, publish_folder};
use clift_data::{
    EvaluationIndex, Split, SyntheticConfig, SyntheticSource, plural, read_scene, write_chunks, write_evaluation_index,
};
use clift_eval::EvalConfig;
use clift_model::ModelConfig;
use clift_train::parse_config;

use crate::commands::args::parse::parse_size;
use crate::commands::args::shared_args::ChunkArgs;
use crate::commands::args::splits::Splits;
use crate::exit_code::usage_bail;
use crate::output::counter::Counter;
use crate::output::stdout::{print_result, print_warning};
use crate::output::units::file_size;

/// Fewest frames for training and evaluation: two contexts and another frame as target.
const MIN_FRAMES: usize = 3;

const DEFAULT_SCENES: usize = 100;

const INDEX: &str = "evaluation_index.json";

pub fn run(args: &SynthArgs) -> anyhow::Result<()> {
    let config = config(args)?;
    require_absent(&args.out, args.split)?;
    let (size, [width, height]) = ([config.width, config.height], cropped(&config));
    if size != [width, height] && width > 0 && height > 0 {
        let (size, patch) = (format!("{}x{}", size[0], size[1]), patch_size());
        print_warning(format!(
            "{size} is not a multiple of the {patch}x{patch} patch: training crops images to {width}x{height}"
        ));
    }
    // Both splits appear together: an interrupted command leaves none.
    let written: Vec<WrittenSplit> =
        args.split.list().iter().map(|&split| write_split(args, &config, split)).collect::<anyhow::Result<_>>()?;
    for split in written {
        split.publish(args)?;
    }
    let present = |split: Split| args.out.join(split.to_string()).join("index.json").exists();
    for split in [Split::Train, Split::Test].into_iter().filter(|split| !present(*split)) {
        let out = args.out.display();
        print_result(&format!("no {split} split; training needs both: clift data synth {out} --split {split}"))?;
    }
    let root = std::path::absolute(&args.out).context("resolving the path of the folder")?;
    match snippet(&config, &root, has_views(&root.join(INDEX))) {
        Ok(lines) => print_result(&format!("\nConfig section:\n\n{lines}")),
        Err(reason) => print_result(&format!("no config section: {reason}")),
    }
}

/// A split in a temporary folder.
struct WrittenSplit {
    source: SyntheticSource,
    split: Split,
    unfinished: PathBuf,
    /// Line to print: scenes, image size and time.
    summary: String,
}

fn write_split(args: &SynthArgs, config: &SyntheticConfig, split: Split) -> anyhow::Result<WrittenSplit> {
    let source = SyntheticSource::new(SyntheticConfig { split, ..config.clone() })?;
    let started = Instant::now();
    let mut counter = Counter::new(&split.to_string(), config.num_scenes as u64);
    let unfinished = args.out.join(format!("{TEMPORARY}{split}"));
    if unfinished.exists() {
        let removing = || format!("removing the folder of an interrupted command, {}", unfinished.display());
        std::fs::remove_dir_all(&unfinished).with_context(removing)?;
    }
    let mut image_bytes = 0;
    let scenes = (0..config.num_scenes).map(|scene| {
        let (record, _) = read_scene(&source, scene, args.chunks.encoding(), None)?;
        image_bytes += record.image_bytes();
        counter.set(scene as u64 + 1);
        Ok(record)
    });
    let num_scenes = write_chunks(&unfinished, scenes, args.chunks.target_bytes())?;
    drop(counter);
    let (scenes, frames) = (plural(num_scenes, "scene"), plural(config.num_frames, "frame"));
    let size = format!("{}x{}", config.width, config.height);
    let (bytes, seconds) = (file_size(image_bytes), started.elapsed().as_secs_f64());
    let summary = format!("{split}: {scenes} of {frames}, {size}, {bytes} in {seconds:.1} s");
    Ok(WrittenSplit { source, split, unfinished, summary })
}

impl WrittenSplit {
    /// Renames the folder, and writes the index of a test split.
    fn publish(self, args: &SynthArgs) -> anyhow::Result<()> {
        let folder = args.out.join(self.split.to_string());
        publish_folder(&self.unfinished, &folder).with_context(|| format!("writing {}", folder.display()))?;
        print_result(&format!("{}: {}", self.summary, folder.display()))?;
        if self.split != Split::Test {
            return Ok(());
        }
        let EvalConfig { num_context, num_targets, .. } = EvalConfig::default();
        let path = args.out.join(INDEX);
        if write_evaluation_index(&path, &self.source, num_context, num_targets)? == 0 {
            let needed = num_context + num_targets;
            print_warning(format!("the index has no views: the scenes are too short; use at least --frames {needed}"));
        } else {
            let path = path.display();
            print_result(&format!("index: {num_context} contexts and {num_targets} targets per scene: {path}"))?;
        }
        Ok(())
    }
}

fn config(args: &SynthArgs) -> anyhow::Result<SyntheticConfig> {
    let [width, height] = args.size.map_or([None; 2], |size| size.map(Some));
    let options = [("num_frames", args.frames), ("width", width), ("height", height)];
    let options = options.into_iter().filter_map(|(key, value)| Some(format!("{key}={}", value?)));
    let mut overrides = vec![format!("num_scenes={}", args.scenes.unwrap_or(DEFAULT_SCENES))];
    overrides.extend(args.look.as_ref().map(|look| format!("look=\"{look}\"")));
    overrides.extend(options);
    overrides.extend(args.seed.map(|seed| format!("seed={seed}")));
    overrides.extend(args.set.iter().cloned());
    let (config, changed) = parse_config::<SyntheticConfig>(Path::new("--set"), "", &overrides, |_| Ok(()))?;
    if changed.iter().any(|change| change.key == "split") {
        usage_bail!("--set split is not supported; use --split");
    }
    config.validate()?;
    Ok(config)
}

/// Checks that the splits and the index are not there yet.
fn require_absent(out: &Path, splits: Splits) -> anyhow::Result<()> {
    let index = splits.list().contains(&Split::Test).then(|| INDEX.to_owned());
    let names = splits.list().iter().map(ToString::to_string).chain(index);
    match names.map(|name| out.join(name)).find(|path| path.exists()) {
        Some(path) => usage_bail!("{} exists; choose another folder or move it away", path.display()),
        None => Ok(()),
    }
}

/// Returns whether the file is an evaluation index with at least one scene.
fn has_views(index: &Path) -> bool {
    EvaluationIndex::read(index).is_ok_and(|index| index.usable().next().is_some())
}

fn patch_size() -> usize {
    ModelConfig::default().patch_size
}

/// Returns width and height, rounded down to multiples of the patch.
fn cropped(config: &SyntheticConfig) -> [usize; 2] {
    [config.width, config.height].map(|side| side / patch_size() * patch_size())
}

/// Returns the config section that trains and evaluates on the written scenes, or the reason why there is none.
fn snippet(config: &SyntheticConfig, root: &Path, has_index: bool) -> Result<String, String> {
    let quoted = |path: &Path| toml::Value::String(path.to_string_lossy().into_owned()).to_string();
    let num_frames = config.num_frames;
    if num_frames < MIN_FRAMES {
        return Err(format!("{} per scene, training needs at least {MIN_FRAMES}", plural(num_frames, "frame")));
    }
    let [width, height] = cropped(config);
    if width == 0 || height == 0 {
        return Err(format!(
            "the images are smaller than the {patch}x{patch} patch of the model",
            patch = patch_size()
        ));
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

#[derive(Debug, clap::Args)]
pub struct SynthArgs {
    /// Output folder, without the split
    pub out: PathBuf,
    /// Kind of scenes: plain rooms, or scenes with the statistics of photos
    #[arg(long, value_parser = ["rooms", "real"])]
    pub look: Option<String>,
    /// Scenes of each split [default: 100]
    #[arg(long, value_name = "N")]
    pub scenes: Option<usize>,
    /// Frames of each scene [default: 16]
    #[arg(long, value_name = "F")]
    pub frames: Option<usize>,
    /// Width and height of a frame in pixels [default: 32x32]
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    pub size: Option<[usize; 2]>,
    /// Seed of all scenes; different seeds give different scenes [default: 0]
    #[arg(long, value_name = "S")]
    pub seed: Option<u64>,
    /// Write this split
    #[arg(long, value_enum, default_value_t = Splits::Both)]
    pub split: Splits,
    /// Override a key of the scenes; takes precedence over other options; repeatable
    #[arg(long, value_name = "KEY=TOML")]
    pub set: Vec<String>,
    #[command(flatten)]
    pub chunks: ChunkArgs,
}

#[cfg(test)]
mod tests {
    use clift_data::{Look, even_views};
    use clift_train::Config;

    use super::*;

    #[derive(clap::Parser)]
    struct Parsed {
        #[command(flatten)]
        synth: SynthArgs,
    }

    #[test]
    fn set_takes_precedence_over_options() {
        let line = "synth out --scenes 3 --size 16x8 --set width=24 --set specular=0.9";
        let config = config(&<Parsed as clap::Parser>::parse_from(line.split(' ')).synth).unwrap();
        assert_eq!((config.num_scenes, config.width, config.height, config.specular), (3, 24, 8, 0.9));
    }

    #[test]
    fn look_is_a_key_of_the_scenes() {
        let config = |line: &str| config(&<Parsed as clap::Parser>::parse_from(line.split(' ')).synth);
        assert_eq!(config("synth out").unwrap().look, Look::Rooms);
        assert_eq!(config("synth out --look real --size 16x8").unwrap().look, Look::Real);
        let error = config("synth out --look real --set fov_deg=50").unwrap_err();
        assert_eq!(crate::exit_code::exit_code(&error), crate::exit_code::USAGE);
        assert!(error.to_string().contains("look = \"real\" does not use it"), "{error}");
    }

    #[test]
    fn wrong_keys_and_values_are_usage_errors() {
        for set in ["widht=24", "fov_deg=200", "split=\"test\""] {
            let synth = <Parsed as clap::Parser>::parse_from(["synth", "out", "--set", set]).synth;
            let error = config(&synth).unwrap_err();
            assert_eq!(crate::exit_code::exit_code(&error), crate::exit_code::USAGE, "{set}: {error}");
        }
    }

    /// Parses the printed section as part of a whole config.
    fn printed_config(num_frames: usize, size: [usize; 2], has_index: bool) -> Config {
        let config = SyntheticConfig { num_frames, width: size[0], height: size[1], ..Default::default() };
        let lines = snippet(&config, Path::new("/data/a \"room\""), has_index).unwrap();
        let file = format!("run_dir = \"run\"\n{lines}\n[stage1]\n[stage2]\n");
        let (config, _) = parse_config::<Config>(Path::new("a.toml"), &file, &[], |_| Ok(())).unwrap();
        config.validate().unwrap_or_else(|error| panic!("{num_frames} frames: {error}\n{lines}"));
        config
    }

    #[test]
    fn printed_section_is_valid_for_every_frame_count() {
        for num_frames in [3, 4, 5, 6, 7, 16, 200] {
            let config = printed_config(num_frames, [32, 32], false);
            assert_eq!(config.data.root.as_deref(), Some(Path::new("/data/a \"room\"")));
            assert!(config.data.views.max_gap[1] < num_frames);
            assert_eq!(config.eval.index, None);
            let EvalConfig { num_context, num_targets, .. } = config.eval;
            assert!(even_views(num_frames, num_context, num_targets).is_some(), "{num_frames} frames");
        }
        let index = printed_config(16, [32, 32], true).eval.index;
        assert_eq!(index.as_deref(), Some(Path::new("/data/a \"room\"/evaluation_index.json")));
    }

    #[test]
    fn printed_section_crops_to_patches_or_gives_the_reason() {
        let cropped = printed_config(16, [36, 20], false);
        assert_eq!((cropped.data.width, cropped.data.height), (32, 16));
        let reason = |num_frames, width| {
            let config = SyntheticConfig { num_frames, width, ..Default::default() };
            snippet(&config, Path::new("out"), false).unwrap_err()
        };
        assert_eq!(reason(2, 32), "2 frames per scene, training needs at least 3");
        assert_eq!(reason(16, 7), "the images are smaller than the 8x8 patch of the model");
    }

    #[test]
    fn existing_splits_and_indices_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("train")).unwrap();
        let refused = |splits| require_absent(folder.path(), splits).err().map(|error| error.to_string());
        assert_eq!(refused(Splits::Test), None);
        assert!(refused(Splits::Both).unwrap().contains("train exists; choose another folder"));
        std::fs::write(folder.path().join(INDEX), "").unwrap();
        assert!(refused(Splits::Test).unwrap().contains("evaluation_index.json exists"));
    }
}
