//! Ray-traced scenes from a seed: rooms, and scenes like photos (`real`). `source` joins the parts to a data source.
//!
//! - `config`: options of synthetic scenes
//! - `room`: a room, its objects and lamp, the camera's arc through it
//! - `ray_tracer`: small deterministic ray tracer
//! - `real`: scenes with the statistics of photos
//! - `tracing`: patterns of surfaces; solids and light of `real`
//! - `source`: scenes from seeds as a source

pub(crate) mod config;
pub(crate) mod ray_tracer;
pub(crate) mod real;
pub(crate) mod room;
pub(crate) mod source;
pub(crate) mod tracing;
