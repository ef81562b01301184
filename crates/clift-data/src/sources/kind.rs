//! Kinds of data sets.

use serde::{Deserialize, Serialize};
use strum::Display;

/// Kind of a data set: synthetic scenes, or a layout of files on disk.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, Display)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case")]
pub enum SourceKind {
    /// Ray-traced scenes from a seed.
    Synthetic,
    /// The detected layout, one of the layouts below.
    #[default]
    Auto,
    /// Chunks of pixelSplat and DepthSplat: `NNNNNN.torch` files of many scenes with an `index.json`.
    Chunks,
    /// One `.torch` file per scene, as in the authors' released code.
    Scenes,
    /// RealEstate10K: text files of cameras, and folders of frames.
    Re10kTxt,
    /// DL3DV: folders named by hash, with `transforms.json` and `images_8` or `images_4`. Lens distortion is ignored, as
    /// in published results.
    Dl3dv,
    /// Own captures: one folder per scene, with `transforms.json` or a COLMAP model. Images are undistorted.
    Captures,
}
