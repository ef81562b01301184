//! The networks of every architecture behind one interface.
//!
//! Read in this order: `architecture` and `config` name a network and its sizes; `design` is the interface of an
//! architecture; the folder `clift` and the files `released` (the published checkpoints) and `lvsm_ed` (a baseline) implement
//! it; `architectures` answers for the one that a config names. The rest of the program asks what a network can do, not
//! which one it is.
//!
//! `parts` holds the encoder, the condenser and the renderer of a model, each one of the architectures' modules; `model` joins
//! them; `pass` lists the blocks of a forward pass, for activation checkpointing.
//!
//! `tokens` are tokens with the transforms of camera-relative attention, which `camera_encoding` makes of the cameras;
//! `render_tokens` are those of target views, and what a renderer caches of them.
//!
//! `blocks` holds the transformer layers, `init` their initial weights, and `layers` the description of every layer
//! from which costs and parameter names are derived.

pub(crate) mod architecture;
pub(crate) mod architectures;
pub(crate) mod blocks;
pub(crate) mod camera_encoding;
pub(crate) mod clift;
pub(crate) mod config;
pub(crate) mod design;
pub(crate) mod init;
pub(crate) mod layers;
pub(crate) mod lvsm_ed;
pub(crate) mod model;
pub(crate) mod parts;
pub(crate) mod pass;
pub(crate) mod released;
pub(crate) mod render_tokens;
pub(crate) mod tokens;
