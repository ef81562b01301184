//! COLMAP's steps from photos to a model: features, matches, mapping.

use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};

use anyhow::Context;

use crate::commands::data::tool::Tool;
use crate::output::stdout::print_note;

/// Frames on each side that a frame of a sequence is matched with, and as many at distances of powers of two.
const OVERLAP: usize = 15;

/// A photogrammetry project of COLMAP in a folder of its own, with settings for 20 to 200 photos.
pub(crate) struct Colmap<'a> {
    pub tool: Tool<'a>,
    pub images: &'a Path,
    pub folder: &'a Path,
    /// Whether all photos have one size, and so one camera.
    pub single_camera: bool,
    /// Whether a photo is matched with its neighbours only, not with all others.
    pub sequential: bool,
    pub use_gpu: bool,
}

impl Colmap<'_> {
    /// Finds features in every photo. Photos that the database has are kept.
    pub fn extract_features(&self) -> anyhow::Result<()> {
        let [single, gpu] = [self.single_camera, self.use_gpu].map(|on| if on { "1" } else { "0" });
        let model = if self.single_camera { "OPENCV" } else { "SIMPLE_RADIAL" };
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
        let gpu = if self.use_gpu { "1" } else { "0" };
        let gpu = (&["SiftMatching.use_gpu", "FeatureMatching.use_gpu"][..], gpu);
        if self.sequential {
            let overlap = OVERLAP.to_string();
            self.run("sequential_matcher", "matches", &[], &[gpu, (&["SequentialMatching.overlap"], &overlap)])
        } else {
            // COLMAP commits a block at its end: small ones, so that an interrupted command loses little.
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
        print_note(&format!("COLMAP: {noun}; {} has its progress", self.tool.log.display()));
        self.tool.run(&args)
    }
}
