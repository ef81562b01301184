//! Patterns of surfaces; solids and light of scenes with many surfaces, traced four rays at a time.
//!
//! - `noise`: hashes, filtered noise and waves
//! - `surface`: patterns on surfaces
//! - `solid`, `tree`, `world`: convex solids, the tree of boxes around them, all surfaces of a scene
//! - `light`: the light along a ray
//! - `render`: frames

pub(crate) mod light;
pub(crate) mod noise;
pub(crate) mod render;
pub(crate) mod solid;
pub(crate) mod surface;
pub(crate) mod tree;
pub(crate) mod world;
