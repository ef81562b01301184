//! Evaluations and what they write, scene files, published checkpoints.

pub mod checkpoints;
mod coded;
pub mod eval;
mod lvsm;
mod scene_files;
mod splits;
mod tiles;
