//! `clift data convert`.

use std::path::{Component, Path, PathBuf};
use std::time::Instant;

use anyhow::Context;
use clap::ValueEnum;
use clift_data::{
    ConversionReport, ConvertOptions, ConvertTo, Converter, KEPT_FOR_TESTING, SkippedScene, UnreadableImage, plural,
};

use crate::commands::args::parse::parse_count;
use crate::commands::args::shared_args::ChunkArgs;
use crate::commands::args::splits::{SourceArgs, SplitSource, Splits, open_splits};
use crate::exit_code::usage_bail;
use crate::output::counter::Counter;
use crate::output::stdout::{print_note, print_result};
use crate::output::units::file_size;
use crate::output::visible::visible_line;

/// Most skipped scenes, and most unreadable images, that are printed; `skipped.json` and `unreadable.json` list all.
const MAX_LISTED: usize = 50;

/// Converts the splits and prints the skipped scenes; fails if no scene of a split can be converted, and if an image file is
/// unreadable.
pub fn run(args: &ConvertArgs) -> anyhow::Result<()> {
    let to = match args.to {
        ConvertForm::Chunks => ConvertTo::Chunks { target_bytes: args.chunks.target_bytes() },
        ConvertForm::Scenes => ConvertTo::Scenes,
    };
    let files = args.source.files()?;
    let options = ConvertOptions { to, encoding: args.chunks.encoding(), max_size: args.max_size };

    let dir = &args.source.dir;
    let splits = open_splits(dir, args.split, &files)?;
    // Every output folder is checked before the first is written.
    let mut converters = Vec::new();
    for split in &splits {
        split.print_report();
        // A data set without splits stays one.
        let folder = split.split.map_or_else(|| args.out.clone(), |split| args.out.join(split.to_string()));
        require_disjoint(dir, &folder)?;
        let opened = &split.opened;
        converters.push((split, Converter::open(opened.source.as_ref(), &opened.report, &folder, &options)?, folder));
    }
    let (mut empty, mut num_unreadable) = (Vec::new(), 0);
    for (split, converter, folder) in converters {
        let started = Instant::now();
        let mut counter = Counter::new(&split.name(), split.opened.source.num_scenes() as u64);
        let report = converter.run(|done| counter.set(done as u64))?;
        drop(counter);
        // Scenes reserved for testing are part of the other split.
        let skips = report.skipped.skips.iter().filter(|skip| skip.reason != KEPT_FOR_TESTING);
        print_some(skips.map(|SkippedScene { key, reason }| format!("skipped {}: {reason}", visible_line(key))));
        if report.skipped.has_skips() {
            print_note(&format!("all skipped scenes and frames: {}", folder.join("skipped.json").display()));
        }
        print_some(report.unreadable.iter().map(|UnreadableImage { key, frame, reason }| {
            format!("unreadable: frame {frame} of scene {}: {reason}", visible_line(key))
        }));
        if !report.unreadable.is_empty() {
            print_note(&format!("all unreadable images: {}", folder.join("unreadable.json").display()));
        }
        num_unreadable += report.unreadable.len();
        print_result(&describe(split, &report, started.elapsed().as_secs_f64(), &folder))?;
        if report.num_scenes == 0 {
            empty.push(split.name());
        }
    }
    anyhow::ensure!(empty.is_empty(), "no scene of {} could be converted: {}", empty.join(", "), dir.display());
    anyhow::ensure!(
        num_unreadable == 0,
        "{} unreadable, copied as found and listed above; replace the files in {} and convert to a new folder",
        plural(num_unreadable, "image"),
        dir.display()
    );
    Ok(())
}

/// Prints the first lines and the number of the others.
fn print_some(mut lines: impl Iterator<Item = String>) {
    lines.by_ref().take(MAX_LISTED).for_each(|line| print_note(&line));
    let num_more = lines.count();
    if num_more > 0 {
        print_note(&format!("and {num_more} more"));
    }
}

fn describe(split: &SplitSource, report: &ConversionReport, seconds: f64, folder: &Path) -> String {
    let ConversionReport { num_scenes, num_frames, num_encoded, image_bytes, unreadable, skipped } = report;
    let optional = |number: usize, text: &str| if number > 0 { format!(", {number} {text}") } else { String::new() };
    let unreadable = optional(unreadable.len(), "unreadable");
    format!(
        "{}: {} of {}; {} written, {} copied and {num_encoded} encoded{unreadable}, {} in {seconds:.1} s: {}",
        split.name(),
        plural(*num_scenes, "scene"),
        skipped.num_scenes,
        plural(*num_frames, "frame"),
        num_frames - num_encoded,
        file_size(*image_bytes),
        folder.display(),
    )
}

/// Checks that neither folder contains the other: the output would change the input.
fn require_disjoint(dir: &Path, folder: &Path) -> anyhow::Result<()> {
    let dir = dir.canonicalize().with_context(|| format!("opening {}", dir.display()))?;
    let target = real_path(folder).with_context(|| format!("resolving the path of {}", folder.display()))?;
    if target.starts_with(&dir) || dir.starts_with(&target) {
        let (dir, target) = (dir.display(), target.display());
        usage_bail!("input {dir} and output {target} contain one another; choose an output folder outside the input");
    }
    Ok(())
}

/// Returns the absolute path of a folder that may not exist yet, with links resolved.
fn real_path(path: &Path) -> std::io::Result<PathBuf> {
    let path = std::path::absolute(path)?;
    let existing = path.ancestors().find(|ancestor| ancestor.exists()).unwrap_or(&path);
    let missing = path.strip_prefix(existing).unwrap_or(Path::new(""));
    let mut real = existing.canonicalize()?;
    for part in missing.components() {
        match part {
            Component::ParentDir => drop(real.pop()),
            part => real.push(part),
        }
    }
    Ok(real)
}

#[derive(Debug, clap::Args)]
pub struct ConvertArgs {
    #[command(flatten)]
    pub source: SourceArgs,
    /// Output folder: new or empty
    pub out: PathBuf,
    /// Layout to write
    #[arg(long, value_enum)]
    pub to: ConvertForm,
    /// Convert this split, if there are two
    #[arg(long, value_enum, default_value_t = Splits::Both)]
    pub split: Splits,
    /// Reduce images with a side of more than N pixels, and encode them
    #[arg(long, value_name = "N", value_parser = parse_count)]
    pub max_size: Option<usize>,
    #[command(flatten)]
    pub chunks: ChunkArgs,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ConvertForm {
    /// Chunks: NNNNNN.torch files of many scenes, with index.json
    Chunks,
    /// One KEY.torch file per scene
    Scenes,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn output_inside_or_around_the_input_is_refused() {
        let place = tempfile::tempdir().unwrap();
        let at = |name: &str| place.path().join(name);
        std::fs::create_dir_all(at("data/test")).unwrap();
        for (dir, folder, is_refused) in [
            ("data", "data/test", true),
            ("data", "data/packed/test", true),
            ("data", "other/../data/x/test", true),
            ("data/test", "data/test", true),
            ("data/test", "data/train", false),
            ("data", "data-packed/test", false),
            ("data", "packed/test", false),
        ] {
            assert_eq!(require_disjoint(&at(dir), &at(folder)).is_err(), is_refused, "{dir} {folder}");
        }
    }
}
