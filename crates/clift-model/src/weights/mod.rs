//! Weight files, published names, and trained models.
//!
//! `file` reads and writes safetensors in PyTorch's layout; `hash` identifies a set of weights; `shipped_model` is the model
//! inside the program; `model_path` finds the weights and config of a run, and `trained_model` opens them. `published_keys` maps
//! parameter names to those of published checkpoints, and `published_sizes` infers the sizes of a network from the shapes in
//! a checkpoint. `network_adapter` reads weights of a smaller network.

pub(crate) mod file;
pub(crate) mod hash;
pub(crate) mod model_path;
pub(crate) mod network_adapter;
pub(crate) mod published_keys;
pub(crate) mod published_sizes;
pub(crate) mod shipped_model;
pub(crate) mod trained_model;
