//! Kinds of data sets.

use serde::{Deserialize, Serialize};
use strum::Display;

/// Kind of a data set: scenes made on the fly, or a layout of files on disk.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, Display)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case")]
pub enum SourceKind {
    /// Ray-traced rooms made on the fly.
    Synthetic,
    /// The layout that is detected on disk, one of those below.
    #[default]
    Auto,
    /// pixelSplat's and DepthSplat's: `NNNNNN.torch` files of many scenes with an `index.json`.
    Chunks,
    /// The reference's: a `.torch` file per scene.
    Scenes,
    /// RealEstate10K's text files of cameras, and folders of frames.
    Re10kTxt,
    /// DL3DV's folders: `transforms.json` and `images_8` or `images_4`, by hash. Lens distortion is ignored, as the
    /// published numbers do.
    Dl3dv,
    /// Own captures: `transforms.json` or a COLMAP model, a scene per folder. Lens distortion is undone.
    Captures,
}
