//! The networks, one per file.
//!
//! - `architecture`: architecture and variant, by name
//! - `config`: ModelConfig, checked
//! - `layers`: ONE description of all layers
//! - `init`: initial weights from a seed
//! - `encoder`: context views to light-field tokens
//! - `condenser`: equations 1 to 4
//! - `released_condenser`: condenser of the published checkpoints
//! - `render_tokens`: tokens per view; cached keys and values
//! - `renderer`: tokens and a camera to an image
//! - `scene_model`: trait of every architecture
//! - `clift`: encoder, condenser and renderer together
//! - `blocks`: layers of the networks

pub(crate) mod architecture;
pub(crate) mod blocks;
pub(crate) mod clift;
pub(crate) mod condenser;
pub(crate) mod config;
pub(crate) mod encoder;
pub(crate) mod init;
pub(crate) mod layers;
pub(crate) mod released_condenser;
pub(crate) mod render_tokens;
pub(crate) mod renderer;
pub(crate) mod scene_model;
