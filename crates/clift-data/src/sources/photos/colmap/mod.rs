//! COLMAP models.
//!
//! - `model`: cameras and images of a model
//! - `text`: COLMAP text files
//! - `binary`: COLMAP binary files
//! - `reader`: locating and reading a COLMAP model

pub(crate) mod binary;
pub(crate) mod model;
pub(crate) mod reader;
pub(crate) mod text;
