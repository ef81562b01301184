//! COLMAP's steps from photos to a model: features, matches, mapping.

use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};

use anyhow::Context;

use crate::commands::data::tool::Tool;
use crate::output::counter::Counter;

/// Frames on each side that a frame of a sequence is matched with, and as many at distances of powers of two.
const OVERLAP: usize = 15;

/// Settings for 20 to 200 photos.
pub(crate) struct Settings {
    /// Whether all photos have one size, and so one camera.
    pub single_camera: bool,
    /// Whether a photo is matched with its neighbours only, not with all others.
    pub sequential: bool,
    pub use_gpu: bool,
}

/// A photogrammetry project of COLMAP in a folder of its own.
pub(crate) struct Colmap<'a> {
    pub tool: Tool<'a>,
    pub images: &'a Path,
    pub folder: &'a Path,
    pub num_images: usize,
    pub settings: Settings,
}

impl Colmap<'_> {
    /// Finds features in every photo. Photos that the database has are kept.
    pub fn extract_features(&self) -> anyhow::Result<()> {
        let Settings { single_camera, use_gpu, .. } = self.settings;
        let [single, gpu] = [single_camera, use_gpu].map(|on| if on { "1" } else { "0" });
        let model = if single_camera { "OPENCV" } else { "SIMPLE_RADIAL" };
        let options = [
            (&["ImageReader.single_camera"][..], single),
            (&["ImageReader.camera_model"], model),
            (&["SiftExtraction.use_gpu", "FeatureExtraction.use_gpu"], gpu),
            (&["SiftExtraction.max_image_size", "FeatureExtraction.max_image_size"], "1600"),
            (&["SiftExtraction.max_num_features"], "4096"),
        ];
        self.run("feature_extractor", "features", &[("image_path", self.images)], &options)
    }

    /// Matches the features. Pairs that the database has are kept.
    pub fn match_features(&self) -> anyhow::Result<()> {
        let gpu = if self.settings.use_gpu { "1" } else { "0" };
        let gpu = (&["SiftMatching.use_gpu", "FeatureMatching.use_gpu"][..], gpu);
        if self.settings.sequential {
            let overlap = OVERLAP.to_string();
            self.run("sequential_matcher", "matches", &[], &[gpu, (&["SequentialMatching.overlap"], &overlap)])
        } else {
            // Small blocks, for progress.
            self.run("exhaustive_matcher", "matches", &[], &[gpu, (&["ExhaustiveMatching.block_size"], "8")])
        }
    }

    /// Computes cameras and points, and returns the folders of the models with their numbers of photos, the largest first.
    pub fn map(&self, models: &Path) -> anyhow::Result<Vec<(PathBuf, usize)>> {
        let options = [
            (&["Mapper.min_model_size"][..], "3"),
            (&["Mapper.extract_colors"], "0"),
            (&["Mapper.ba_global_function_tolerance"], "1e-6"),
        ];
        self.run("mapper", "cameras", &[("image_path", self.images), ("output_path", models)], &options)?;
        let reading = || format!("reading {}", models.display());
        let mut found = Vec::new();
        for item in std::fs::read_dir(models).with_context(reading)? {
            let folder = item.with_context(reading)?.path();
            // The file begins with its number of images.
            let images = std::fs::read(folder.join("images.bin")).unwrap_or_default();
            if let Some(count) = images.first_chunk() {
                found.push((folder, u64::from_le_bytes(*count) as usize));
            }
        }
        found.sort_by(|(a, num_a), (b, num_b)| num_b.cmp(num_a).then(a.cmp(b)));
        Ok(found)
    }

    /// Runs a command of COLMAP. Of the names of an option, one per generation of COLMAP, the one that its help lists is
    /// used; options that it does not list are left out.
    fn run(
        &self,
        command: &str,
        noun: &str,
        paths: &[(&str, &Path)],
        options: &[(&[&str], &str)],
    ) -> anyhow::Result<()> {
        let help = self.tool.output(&[OsStr::new(command), OsStr::new("-h")])?;
        let mut args: Vec<OsString> = vec![command.into()];
        let database = self.folder.join("database.db");
        for (name, path) in paths.iter().chain([&("database_path", database.as_path())]) {
            args.extend([format!("--{name}").into(), OsString::from(path)]);
        }
        for (names, value) in options {
            if let Some(name) = names.iter().find(|name| help.contains(&format!("--{name} "))) {
                args.extend([format!("--{name}").into(), OsString::from(value)]);
            }
        }
        let mut counter: Option<Counter> = None;
        self.tool.run(&args, |line| {
            if let Some((done, total)) = progress(line) {
                let total = total.unwrap_or(self.num_images as u64);
                counter.get_or_insert_with(|| Counter::new(noun, total)).set(done);
            }
        })
    }
}

/// Returns what a line of COLMAP reports as done, and of how many if it says so: files of the extractor, pairs of blocks or
/// images of the matchers, registered images of the mapper.
fn progress(line: &str) -> Option<(u64, Option<u64>)> {
    let number = |text: &str| text.trim_matches(|c: char| !c.is_ascii_digit()).parse::<u64>().ok();
    let between = |open: char, close: char| Some(line.rsplit_once(open)?.1.split_once(close)?.0);
    if line.contains("Registering image #") {
        let text = between('(', ')')?;
        return Some((number(text.rsplit('=').next()?)?, None));
    }
    if !["Processed file [", "Matching block [", "Processing block [", "Matching image [", "Processing image ["]
        .iter()
        .any(|start| line.contains(start))
    {
        return None;
    }
    let mut done_and_total = Vec::new();
    for pair in between('[', ']')?.split(',') {
        let (done, total) = pair.split_once('/')?;
        done_and_total.push((number(done)?, number(total)?));
    }
    match done_and_total[..] {
        [(done, total)] => Some((done, Some(total))),
        [(row, rows), (column, columns)] => {
            Some((row.saturating_sub(1).saturating_mul(columns).saturating_add(column), rows.checked_mul(columns)))
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn progress_is_read_from_every_generation_of_colmap() {
        for (line, expected) in [
            ("Processed file [7/10]", Some((7, Some(10)))),
            ("I20250101 10:00:00.1 12 feature_extraction.cc:254] Processed file [1/3]", Some((1, Some(3)))),
            ("Matching block [2/3, 1/3] in 8.373s", Some((4, Some(9)))),
            ("I20250101 10:00:00.1 12 pairing.cc:168] Processing block [3/3, 3/3]", Some((9, Some(9)))),
            ("Matching image [3/20] in 0.2s", Some((3, Some(20)))),
            ("Registering image #5 (13)", Some((13, None))),
            ("Registering image #5 (num_reg_frames=13)", Some((13, None))),
            ("  => Image sees 574 / 2259 points", None),
            ("Processed file [?/10]", None),
            ("Processed file", None),
        ] {
            assert_eq!(progress(line), expected, "{line}");
        }
    }
}
