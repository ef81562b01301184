//! `clift data synth`.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context;
use clift_core::{TEMPORARY, plural, publish_folder};
use clift_data::{Split, SyntheticConfig, SyntheticSource, read_scene, write_chunks, write_evaluation_index};
use clift_eval::EvalConfig;
use clift_train::parse_config;

use crate::commands::args::parse::parse_size;
use crate::commands::args::splits::Splits;
use crate::exit_code::usage_bail;
use crate::output::counter::Counter;
use crate::output::stdout::{print_result, print_warning};
use crate::output::units::file_size;

const INDEX: &str = "evaluation_index.json";
/// Bytes of images at which a chunk is closed.
const CHUNK_BYTES: u64 = 100_000_000;

pub fn run(args: &SynthArgs) -> anyhow::Result<()> {
    let config = config(args)?;
    require_absent(&args.out, args.split)?;
    // Both splits appear together: an interrupted command leaves none.
    let splits = args.split.list().iter().map(|&split| write_split(args, &config, split));
    splits.collect::<anyhow::Result<Vec<_>>>()?.into_iter().try_for_each(|split| split.publish(&args.out))
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
        let record = read_scene(&source, scene)?;
        image_bytes += record.image_bytes();
        counter.set(scene as u64 + 1);
        Ok(record)
    });
    let num_scenes = write_chunks(&unfinished, scenes, CHUNK_BYTES)?;
    drop(counter);
    let summary = format!(
        "{split}: {} of {}, {}x{}, {} in {:.1} s",
        plural(num_scenes, "scene"),
        plural(config.num_frames, "frame"),
        config.width,
        config.height,
        file_size(image_bytes),
        started.elapsed().as_secs_f64()
    );
    Ok(WrittenSplit { source, split, unfinished, summary })
}

impl WrittenSplit {
    fn publish(self, out: &Path) -> anyhow::Result<()> {
        let folder = out.join(self.split.to_string());
        publish_folder(&self.unfinished, &folder).with_context(|| format!("writing {}", folder.display()))?;
        print_result(&format!("{}: {}", self.summary, folder.display()))?;
        if self.split != Split::Test {
            return Ok(());
        }
        let EvalConfig { num_context, num_targets, .. } = EvalConfig::default();
        let path = out.join(INDEX);
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
    let mut overrides = vec![format!("num_scenes={}", args.scenes)];
    overrides.extend(args.look.as_ref().map(|look| format!("look=\"{look}\"")));
    overrides.extend(options);
    overrides.extend(args.seed.map(|seed| format!("seed={seed}")));
    overrides.extend(args.set.iter().cloned());
    let (config, set_keys) = parse_config::<SyntheticConfig>(Path::new("--set"), "", &overrides, |_| Ok(()))?;
    if set_keys.iter().any(|key| key == "split") {
        usage_bail!("--set split is not supported; use --split");
    }
    config.validate()?;
    Ok(config)
}

fn require_absent(out: &Path, splits: Splits) -> anyhow::Result<()> {
    let index = splits.list().contains(&Split::Test).then(|| INDEX.to_owned());
    let names = splits.list().iter().map(ToString::to_string).chain(index);
    match names.map(|name| out.join(name)).find(|path| path.exists()) {
        Some(path) => usage_bail!("{} exists; choose another folder or move it away", path.display()),
        None => Ok(()),
    }
}

#[derive(Debug, clap::Args)]
pub struct SynthArgs {
    /// Output folder, without the split
    pub out: PathBuf,
    /// Kind of scenes: plain rooms, or scenes with the statistics of photos
    #[arg(long, value_parser = ["rooms", "real"])]
    pub look: Option<String>,
    /// Scenes of each split
    #[arg(long, value_name = "N", default_value_t = 100)]
    pub scenes: usize,
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
}

#[cfg(test)]
mod tests {
    use clift_data::Look;

    use super::*;

    #[derive(clap::Parser)]
    struct Parsed {
        #[command(flatten)]
        synth: SynthArgs,
    }

    fn read(line: &str) -> anyhow::Result<SyntheticConfig> {
        config(&<Parsed as clap::Parser>::parse_from(line.split(' ')).synth)
    }

    #[test]
    fn set_takes_precedence_over_options_and_wrong_keys_are_usage_errors() {
        let config = read("synth out --look real --scenes 3 --size 16x8 --set width=24").unwrap();
        assert_eq!((config.look, config.num_scenes, config.width, config.height), (Look::Real, 3, 24, 8));
        for set in ["widht=24", "fov_deg=200", "split=\"test\"", "specular=0.5 --look real"] {
            let error = read(&format!("synth out --set {set}")).unwrap_err();
            assert_eq!(crate::exit_code::exit_code(&error), crate::exit_code::USAGE, "{set}: {error}");
        }
    }
}
