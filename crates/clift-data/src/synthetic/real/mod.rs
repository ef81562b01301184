//! Scenes with the statistics of photos, for training networks that draw real places (after `MegaSynth`, CVPR 2025):
//! meaningless, but with edges and texture of many scales, depth, shadow, highlights and the cameras of real clips.
//!
//! - `dice`: random choices and colours of one scene
//! - `builder`: puts solids together
//! - `materials`, `furniture`, `interior`, `outdoor`: what a scene is made of
//! - `path`: camera paths
//! - `scene`: a scene from a random stream

pub(crate) mod builder;
pub(crate) mod dice;
pub(crate) mod furniture;
pub(crate) mod interior;
pub(crate) mod materials;
pub(crate) mod outdoor;
pub(crate) mod path;
pub(crate) mod scene;
