//! One file or folder per command, named after the command: its arguments, the call, the printed result.
//!
//! Shared by the commands: the folder `args`.

pub(crate) mod args;
pub(crate) mod bench;
pub(crate) mod codec;
pub(crate) mod compare;
pub(crate) mod data;
pub(crate) mod doctor;
pub(crate) mod encode;
pub(crate) mod eval;
pub(crate) mod export;
pub(crate) mod flops;
pub(crate) mod import;
pub(crate) mod metrics;
pub(crate) mod plan;
pub(crate) mod render;
pub(crate) mod train;
pub(crate) mod view;
