//! Evaluations and what they write, scene files, videos, published checkpoints.

mod checkpoints;
mod coded;
pub mod eval;
mod lvsm;
mod report;
mod scene_files;
mod splits;
mod tiles;
mod videos;
