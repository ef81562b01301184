//! `clift data convert`.

use std::path::{Component, Path, PathBuf};
use std::time::Instant;

use anyhow::Context;
use clap::ValueEnum;
use clift_data::{
    ConversionReport, ConvertOptions, ConvertTo, Converter, ImageEncoding, KEPT_FOR_TESTING, SkipReport, SkippedScene,
    Split,
};

use crate::commands::data::text::{bytes, count};
use crate::commands::splits::{SplitSource, Splits, files, splits};
use crate::exit_code::UsageError;
use crate::output::counter::Counter;
use crate::output::stdout::{print_note, print_result};

/// Scenes that are named when they are left out; `skipped.json` has all.
const MAX_SKIPS_SHOWN: usize = 50;

/// Converts both halves and says what was left out. Fails where a half has no scene.
pub fn run(args: &ConvertArgs) -> anyhow::Result<()> {
    let to = match args.to {
        ConvertForm::Chunks => ConvertTo::Chunks { target_bytes: args.chunk_mb * 1_000_000 },
        ConvertForm::Scenes => ConvertTo::Scenes,
    };
    let (files, mut changes) = files(&args.set)?;
    // The list says which scenes there are, and nothing about how they look.
    changes.retain(|change| change.key != "data.files.test_scenes");
    changes.sort_by(|a, b| a.key.cmp(&b.key));
    let opened_with = changes.iter().map(|change| format!("{}={}", change.key, change.to)).collect::<Vec<_>>();
    let encoding = args.quality.map_or(ImageEncoding::Png, ImageEncoding::Jpeg);
    let options = ConvertOptions { to, encoding, opened_with: opened_with.join(" ") };

    let halves = splits(&args.dir, args.split, &files)?;
    // All folders are looked at before anything is written to one.
    let mut conversions = Vec::new();
    for half in &halves {
        half.print_news();
        // A folder that is not divided becomes the test half: what `clift eval` and `clift encode` read.
        let folder = args.out.join(half.split.unwrap_or(Split::Test).to_string());
        refuse_overlap(&args.dir, &folder)?;
        let opened = &half.opened;
        conversions.push((half, Converter::open(opened.source.as_ref(), &opened.report, &folder, &options)?, folder));
    }
    let mut empty = Vec::new();
    for (half, conversion, folder) in conversions {
        let started = Instant::now();
        let mut counter = Counter::new(&half.name(), half.opened.source.num_scenes() as u64);
        let converted = conversion.run(|done| counter.set(done as u64))?;
        drop(counter);
        print_skips(&converted.skipped, &folder);
        print_result(&told(half, &converted, started.elapsed().as_secs_f64(), &folder))?;
        if converted.num_scenes == 0 {
            empty.push(half.name());
        }
    }
    anyhow::ensure!(
        empty.is_empty(),
        "not one scene could be converted ({}): {}",
        empty.join(", "),
        args.dir.display()
    );
    Ok(())
}

fn told(half: &SplitSource, converted: &ConversionReport, seconds: f64, folder: &Path) -> String {
    let ConversionReport { num_scenes, num_found, num_changed, num_frames, num_encoded, image_bytes, skipped } =
        converted;
    let counted = |number: usize, what: &str| if number > 0 { format!(", {number} {what}") } else { String::new() };
    let found = counted(*num_found, "of them there already");
    let changed = counted(*num_changed, "made anew, which had other cameras or frames");
    format!(
        "{}: {} of {}{found}{changed}; {} written, {} as they were and {num_encoded} encoded, {} in {seconds:.1} s: {}",
        half.name(),
        count(*num_scenes, "scene"),
        skipped.num_scenes,
        count(*num_frames, "frame"),
        num_frames - num_encoded,
        bytes(*image_bytes),
        folder.display(),
    )
}

fn print_skips(left_out: &SkipReport, folder: &Path) {
    // The test half has them.
    let skips: Vec<&SkippedScene> = left_out.skips.iter().filter(|skip| skip.reason != KEPT_FOR_TESTING).collect();
    for skip in skips.iter().take(MAX_SKIPS_SHOWN) {
        print_note(&format!("left out {}: {}", skip.key, skip.reason));
    }
    let num_more = skips.len().saturating_sub(MAX_SKIPS_SHOWN);
    if num_more > 0 {
        print_note(&format!("left out {num_more} more"));
    }
    if left_out.has_gaps() {
        print_note(&format!("all that is left out, by name: {}", folder.join("skipped.json").display()));
    }
}

/// Refuses to write where the source's scenes are looked for, or around them.
fn refuse_overlap(dir: &Path, folder: &Path) -> anyhow::Result<()> {
    let dir = dir.canonicalize().with_context(|| format!("opening {}", dir.display()))?;
    let target = real_path(folder).with_context(|| format!("finding the full path of {}", folder.display()))?;
    if target.starts_with(&dir) || dir.starts_with(&target) {
        let message = format!(
            "scenes of {} would be written to {}: the one is in the other, and writing would change what is read; \
             choose a folder beside it",
            dir.display(),
            target.display()
        );
        return Err(UsageError(message).into());
    }
    Ok(())
}

/// The full path, without links, of a folder that may not be there yet.
fn real_path(path: &Path) -> std::io::Result<PathBuf> {
    let path = std::path::absolute(path)?;
    let there = path.ancestors().find(|ancestor| ancestor.exists()).unwrap_or(&path);
    let missing = path.strip_prefix(there).unwrap_or(Path::new(""));
    let mut real = there.canonicalize()?;
    for part in missing.components() {
        match part {
            Component::ParentDir => drop(real.pop()),
            part => real.push(part),
        }
    }
    Ok(real)
}

/// Arguments of `clift data convert`.
#[derive(Debug, clap::Args)]
pub struct ConvertArgs {
    /// Scenes in any layout, or one scene
    pub dir: PathBuf,
    /// Folder to write to: new, or one that an interrupted conversion left
    pub out: PathBuf,
    /// What to write
    #[arg(long, value_enum)]
    pub to: ConvertForm,
    /// Which half, where there are two
    #[arg(long, value_enum, default_value_t = Splits::Both)]
    pub split: Splits,
    /// Size at which a chunk is closed, in megabytes of pictures
    #[arg(long, value_name = "M", default_value_t = 100, value_parser = clap::value_parser!(u64).range(1..=4000))]
    pub chunk_mb: u64,
    /// Store pictures that need encoding as JPEG of this quality, 1 to 100, instead of PNG (without loss)
    #[arg(long, value_name = "Q", value_parser = clap::value_parser!(u8).range(1..=100))]
    pub quality: Option<u8>,
    /// Say where parts of the layout are, as in a config: `--set data.files.image_folder=images_4`
    #[arg(long, value_name = "data.files.KEY=TOML")]
    pub set: Vec<String>,
}

/// What is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ConvertForm {
    /// NNNNNN.torch files of many scenes, with index.json
    Chunks,
    /// A KEY.torch file per scene
    Scenes,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_in_the_source_or_around_it_is_refused_and_one_beside_it_is_not() {
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
            let refused = refuse_overlap(&at(dir), &at(folder));
            assert_eq!(refused.is_err(), is_refused, "{dir} {folder}");
            assert!(refused.err().is_none_or(|error| error.is::<UsageError>()));
        }
    }
}
