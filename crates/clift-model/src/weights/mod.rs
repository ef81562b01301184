//! Weight files, published names, trained models.
//!
//! - `file`: safetensors in PyTorch's layout
//! - `hash`: SHA-256 of a set of weights
//! - `published_keys`: parameter names of published checkpoints
//! - `published_sizes`: network sizes inferred from shapes
//! - `model_path`: find a run's weights and config
//! - `trained_model`: a trained model, ready to use

pub(crate) mod file;
pub(crate) mod hash;
pub(crate) mod model_path;
pub(crate) mod published_keys;
pub(crate) mod published_sizes;
pub(crate) mod trained_model;
