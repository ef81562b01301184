//! Options of opening a data set.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::sources::filters::SceneFilters;
use crate::sources::kind::SourceKind;

/// Where the parts of a layout are, if not where they are expected.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FileOptions {
    /// Keys of the scenes kept for testing and out of training: an evaluation index, a JSON list or a key per line.
    pub test_scenes: Option<PathBuf>,
    /// Folder of the frames of `re10k_txt`, with a folder per key in it or in `train/` and `test/` below it.
    pub frames: Option<PathBuf>,
    /// Folder of the pictures within a scene of `dl3dv` or `captures`, such as `images_4`.
    pub image_folder: Option<String>,
    /// Whether lens distortion is undone; by default in `captures` alone.
    pub undistort: Option<bool>,
    /// Whether scenes of `re10k_txt` and `dl3dv` with missing pictures are used without these frames. Positions of
    /// frames then differ from those that published indices count.
    pub keep_incomplete: bool,
}

/// Options of opening a data set on disk.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SourceOptions {
    /// Layout, or [`SourceKind::Auto`]. [`SourceKind::Synthetic`] is refused.
    pub kind: SourceKind,
    /// Filters of the scenes.
    pub filters: SceneFilters,
    /// Paths of the parts of the layout.
    pub files: FileOptions,
    /// Fewest columns and rows of a usable image; for layouts of one file per frame.
    pub min_size: [usize; 2],
    /// Whether every chunk is read even where no filter needs it: unreadable scenes, and scenes that `index.json` does
    /// not name, are then in the report.
    pub reads_chunks: bool,
}
