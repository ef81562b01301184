//! Scenes with the statistics of photos, for training networks that draw real places (after `MegaSynth`, CVPR 2025):
//! meaningless, but with edges and texture of many scales, depth, shadow, highlights and the cameras of real clips.
//!
//! - `dice`, `noise`: random choices of a scene; hashes and filtered noise on surfaces
//! - `palette`, `surface`: colours and patterns
//! - `solid`, `tree`, `world`: convex solids, four rays at once
//! - `light`, `render`: light along a ray, frames
//! - `path`: camera paths
//! - `builder`, `materials`, `furniture`, `interior`, `outdoor`: what a scene is put together from
//! - `scene`: a scene from a random stream

pub(crate) mod builder;
pub(crate) mod dice;
pub(crate) mod furniture;
pub(crate) mod interior;
pub(crate) mod light;
pub(crate) mod materials;
pub(crate) mod noise;
pub(crate) mod outdoor;
pub(crate) mod palette;
pub(crate) mod path;
pub(crate) mod render;
pub(crate) mod scene;
pub(crate) mod solid;
pub(crate) mod surface;
pub(crate) mod tree;
pub(crate) mod world;
