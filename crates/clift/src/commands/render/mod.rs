//! `clift render`: `run` prepares the renderer and the cameras, `frames` renders and writes.

pub(crate) mod args;
pub(crate) mod frames;
pub(crate) mod run;
