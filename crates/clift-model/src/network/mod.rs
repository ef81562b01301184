//! The networks: `architecture` names them, `config` has their sizes and what they can do.
//!
//! `encoder`, `condenser` and `renderer` are the parts of a model, `lvsm_ed` what LVSM (a baseline) has in their place; `model`
//! joins them.
//!
//! `tokens` are tokens with the transforms of camera-relative attention, which `camera_encoding` makes of the cameras;
//! `render_tokens` are those of target views, and what a renderer caches of them.
//!
//! `blocks` holds the transformer layers, `init` their initial weights, and `layers` the description of every layer
//! from which costs and parameter names are derived.

pub(crate) mod architecture;
pub(crate) mod blocks;
pub(crate) mod camera_encoding;
pub(crate) mod condenser;
pub(crate) mod config;
pub(crate) mod encoder;
pub(crate) mod init;
pub(crate) mod layers;
pub(crate) mod lvsm_ed;
pub(crate) mod model;
pub(crate) mod render_tokens;
pub(crate) mod renderer;
pub(crate) mod tokens;
