//! Scenes with one image file per frame.
//!
//! - `photo`: an image file with its camera
//! - `image_folder`: look-up of image files by name
//! - `image_locator`: images named by a camera file, wherever they are
//! - `nerfstudio`: transforms.json (nerfstudio, DL3DV)
//! - `re10k_text`: RealEstate10K camera text files
//! - `scene_folder`: folders that hold one scene
//! - `photo_source`: scenes of one file per frame
//! - `colmap`: COLMAP models

pub(crate) mod colmap;
pub(crate) mod image_folder;
pub(crate) mod image_locator;
pub(crate) mod nerfstudio;
pub(crate) mod photo;
pub(crate) mod photo_source;
pub(crate) mod re10k_text;
pub(crate) mod scene_folder;
