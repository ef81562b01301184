//! Data sets on disk: kinds, detection and opening.
//!
//! - `kind`: kinds of data sets
//! - `options`: options of opening a data set
//! - `filters`: filters of scenes
//! - `keys`: scene keys: DL3DV hashes, look-up
//! - `test_scenes`: scenes reserved for testing
//! - `subset`: some scenes of a source, or scenes without the frames held out of training
//! - `dataset_root`: split folders, detection of the layout
//! - `open`: opening any layout as a source
//! - `chunks`: pixelSplat chunks
//! - `photos`: one image file per frame

pub(crate) mod chunks;
pub(crate) mod dataset_root;
pub(crate) mod filters;
pub(crate) mod keys;
pub(crate) mod kind;
pub(crate) mod open;
pub(crate) mod options;
pub(crate) mod photos;
pub(crate) mod subset;
pub(crate) mod test_scenes;
