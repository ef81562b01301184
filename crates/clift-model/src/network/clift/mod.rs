//! `CLiFT`: light-field tokens of patches, condensed by clusters, read by cross-attention.
//!
//! `encoder` makes tokens of context views, `condenser` (equations 1 to 4) writes every cluster of tokens into its
//! centroid, `renderer` decodes images. `paper` has the sizes, checks and layers of the paper's network; `released`, beside
//! this folder, has the sizes, checks and layers of the published checkpoints.

pub(crate) mod condenser;
pub(crate) mod encoder;
pub(crate) mod paper;
pub(crate) mod renderer;
