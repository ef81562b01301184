//! The `[data]` section of a config.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::geometry::normalization::{PoseRotation, PoseScale};
use crate::image::fit::Crop;
use crate::sampling::clip_reader::ClipOptions;
use crate::sampling::view_sampler::ViewSampler;
use crate::sources::filters::SceneFilters;
use crate::sources::kind::SourceKind;
use crate::sources::options::FileOptions;
use crate::synthetic::config::SyntheticConfig;

/// Scenes and how views are drawn from them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DataConfig {
    /// Kind of the data set.
    pub source: SourceKind,
    /// Folder with `train/` and `test/`, or of scenes, or of one scene; for scenes on disk.
    pub root: Option<PathBuf>,
    /// Where the parts of a layout are, if not where they are expected; for scenes on disk.
    pub files: FileOptions,
    /// Columns of every view, a multiple of the patch.
    pub width: usize,
    /// Rows of every view, a multiple of the patch.
    pub height: usize,
    /// How the mean orientation of the contexts is taken.
    pub pose_rotation: PoseRotation,
    /// Which cameras set the scale of a scene: contexts only, or targets as well (the reference's numbers).
    pub pose_scale: PoseScale,
    /// Whether the principal point follows the crop exactly: an older way to write `crop = "exact"`.
    pub exact_principal_point: bool,
    /// Where the principal point goes when pictures are cropped: `protocol`, as in published numbers, or `exact`.
    #[serde(skip_serializing_if = "Crop::is_default")]
    pub crop: Crop,
    /// Whether stage 1 flips half of its clips left to right. Stage 2 trains on clusters of clips as they are.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub flip: bool,
    /// Which scenes of the files are used.
    pub filters: SceneFilters,
    /// The synthetic scenes.
    pub synthetic: SyntheticConfig,
    /// How context and target frames are drawn for training.
    pub views: ViewSampler,
    /// Threads that prepare batches; 0 prepares them between the steps.
    pub num_threads: usize,
    /// Batches prepared ahead.
    pub num_prefetch: usize,
}

impl Default for DataConfig {
    fn default() -> Self {
        Self {
            source: SourceKind::Synthetic,
            root: None,
            files: FileOptions::default(),
            width: 256,
            height: 256,
            pose_rotation: PoseRotation::default(),
            pose_scale: PoseScale::default(),
            exact_principal_point: false,
            crop: Crop::Protocol,
            flip: false,
            filters: SceneFilters::default(),
            synthetic: SyntheticConfig::default(),
            views: ViewSampler::default(),
            num_threads: 1,
            num_prefetch: 4,
        }
    }
}

impl DataConfig {
    /// How frames and poses are prepared.
    pub fn clip_options(&self) -> ClipOptions {
        ClipOptions {
            width: self.width,
            height: self.height,
            pose_rotation: self.pose_rotation,
            pose_scale: self.pose_scale,
            exact_principal_point: self.exact_principal_point || self.crop == Crop::Exact,
        }
    }
}
