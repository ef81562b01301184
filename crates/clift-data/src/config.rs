//! The `[data]` section of a config.

use std::path::PathBuf;

use clift_core::{PoseRotation, PoseScale};
use serde::{Deserialize, Serialize};

use crate::sampling::clip_reader::ClipOptions;
use crate::sampling::view_sampler::ViewSampler;
use crate::sources::filters::SceneFilters;
use crate::sources::kind::SourceKind;
use crate::sources::options::FileOptions;
use crate::synthetic::config::SyntheticConfig;

/// Data set, image size, pose normalisation and view sampling.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DataConfig {
    /// Layout of the data: `synthetic`, `auto` (detected), `chunks`, `scenes`, `re10k_txt`, `dl3dv` or `captures`.
    pub source: SourceKind,
    /// Folder with `train/` and `test/`, folder of scenes, or folder of one scene; for data sets on disk.
    pub root: Option<PathBuf>,
    /// Paths of the parts of the layout, where they differ from the default; for data sets on disk.
    pub files: FileOptions,
    /// Columns of every view, a multiple of the patch size.
    pub width: usize,
    /// Rows of every view, a multiple of the patch size.
    pub height: usize,
    /// Mean orientation of the context views: of their `quaternion`s, or of their viewing `axes`.
    pub pose_rotation: PoseRotation,
    /// Cameras that define the scale of a scene: the `context` views, or `all`, contexts and targets (as in the authors'
    /// released code).
    pub pose_scale: PoseScale,
    /// Colour of masked and transparent pixels, RGB of 0 to 255.
    pub background: [u8; 3],
    /// For data sets without a test split: every n-th frame of a scene (0, n, 2 n, ..) is a target of the evaluation and
    /// never read in training, as in the practice of `NeRF`; 0 holds out no frame, and training scenes are evaluated.
    pub hold_out: usize,
    /// Filters of the scenes on disk.
    pub filters: SceneFilters,
    /// Options of the synthetic scenes.
    pub synthetic: SyntheticConfig,
    /// Sampling of context and target frames for training.
    pub views: ViewSampler,
    /// Number of threads that prepare batches; 0 prepares them between the steps. Unset: 1 on a CPU; on a GPU one per core, at
    /// most 16.
    pub num_threads: Option<usize>,
    /// Number of batches prepared ahead, at least one per thread.
    pub num_prefetch: usize,
    /// Smallest width and height of images, where training uses sizes larger than `width` and `height`.
    #[serde(skip)]
    pub min_size: [usize; 2],
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
            background: [0; 3],
            hold_out: 8,
            filters: SceneFilters::default(),
            synthetic: SyntheticConfig::default(),
            views: ViewSampler::default(),
            num_threads: None,
            num_prefetch: 4,
            min_size: [0; 2],
        }
    }
}

impl DataConfig {
    /// Returns the same data with half as many columns and rows, also of the frames of synthetic scenes.
    #[must_use]
    pub fn at_half_resolution(&self) -> Self {
        let mut half = self.clone();
        let Self { width, height, synthetic, .. } = &mut half;
        for side in [width, height, &mut synthetic.width, &mut synthetic.height] {
            *side /= 2;
        }
        half
    }

    /// Returns the options of reading a clip.
    pub fn clip_options(&self) -> ClipOptions {
        ClipOptions {
            width: self.width,
            height: self.height,
            pose_rotation: self.pose_rotation,
            pose_scale: self.pose_scale,
            half_size: false,
        }
    }
}
