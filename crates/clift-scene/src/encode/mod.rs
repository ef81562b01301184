//! Encoding of captured images.
//!
//! - `encode`: contexts, tokens, clusters, condenser

pub(crate) mod encode;
