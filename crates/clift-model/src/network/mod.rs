//! The networks, one per file.
//!
//! Read in this order: `architecture` and `config` name a network and its sizes; `encoder` makes light-field tokens of
//! context views; `condenser` (equations 1 to 4) writes every cluster of tokens into its centroid, and
//! `released_condenser` is the one of the published checkpoints; `render_tokens` holds the tokens of target views, and
//! `renderer` decodes images from them; `clift` joins the three networks.
//!
//! In the encoder-decoder of LVSM, a baseline, the `encoder` encodes learned latents beside the patches, and the `renderer`
//! decodes with `joint_decoder`.
//!
//! `tokens` are tokens with the transforms of camera-relative attention, which `camera_encoding` makes of the cameras.
//!
//! `blocks` holds the transformer layers, `init` their initial weights, and `layers` the description of every layer
//! from which costs and parameter names are derived.

pub(crate) mod architecture;
pub(crate) mod blocks;
pub(crate) mod camera_encoding;
pub(crate) mod clift;
pub(crate) mod condenser;
pub(crate) mod config;
pub(crate) mod encoder;
pub(crate) mod init;
pub(crate) mod joint_decoder;
pub(crate) mod layers;
pub(crate) mod released_condenser;
pub(crate) mod render_tokens;
pub(crate) mod renderer;
pub(crate) mod tokens;
