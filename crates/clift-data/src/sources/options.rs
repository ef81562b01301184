//! Options of opening a data set.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::sources::filters::SceneFilters;
use crate::sources::kind::SourceKind;
use crate::sources::photos::photo::PosesFrom;

/// Paths of the parts of a layout, where they differ from the default.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FileOptions {
    /// File with the keys of the test scenes: an evaluation index, a JSON list, or one key per line.
    pub test_scenes: Option<PathBuf>,
    /// Folder of the frames of `re10k_txt`, with one folder per key, directly or in `train/` and `test/`.
    pub frames: Option<PathBuf>,
    /// Image folder within a scene of `dl3dv` or `captures`, such as `images_4`.
    pub image_folder: Option<String>,
    /// Whether images are undistorted; by default only in `captures`.
    pub undistort: Option<bool>,
    /// Pixels from which the poses were computed, for photos with an EXIF orientation whose cameras fit both: `stored`, as by
    /// COLMAP, or `turned` by the orientation.
    pub poses_from: PosesFrom,
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
    /// Colour of masked and transparent pixels.
    pub background: [u8; 3],
    /// Smallest columns and rows of an image; for layouts with one file per frame.
    pub min_size: [usize; 2],
    /// Whether large photos, scaled to `min_size`, stay in memory after their first use.
    pub caches_photos: bool,
    /// Whether every chunk is read even without filters, so that unreadable scenes and frames are reported.
    pub reads_chunks: bool,
}
