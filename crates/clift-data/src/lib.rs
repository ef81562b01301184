//! Posed photos in, clips out: cameras, data sets and captures in every layout, synthetic scenes, samplers and the
//! loader.
//!
//! This crate does not depend on Burn: its clips and batches are plain host arrays, and
//! `clift_model::Views::upload` is the one place where they meet a device.

mod archive;
pub mod batch;
pub mod camera;
pub mod camera_path;
pub mod chunk;
mod chunk_table;
pub mod chunk_writer;
pub mod clip;
pub mod clip_reader;
mod colmap;
pub mod error;
pub mod export;
pub mod files;
pub mod filters;
pub mod image;
pub mod index;
pub mod info;
pub mod lanczos;
pub mod layout;
pub mod ledger;
pub mod lens;
pub mod loader;
pub mod normalize;
pub mod order;
mod photo;
mod photo_source;
pub mod pickle;
mod picture_folder;
mod re10k_text;
pub mod sampler;
mod scene_folder;
pub mod split;
pub mod spread;
pub mod synthetic;
pub mod test_scenes;
mod transforms;
pub mod undistort;
mod unpickle;

pub use batch::{ClipBatch, TrainingClips};
pub use camera::{Camera, Intrinsics, IntrinsicsNorm, Pose};
pub use chunk::ChunkSource;
pub use chunk_writer::{SceneRecord, write_chunks};
pub use clip::{Clip, Frame, SceneSource, ViewIndices, Views};
pub use clip_reader::{ClipOptions, ClipReader};
pub use error::DataError;
pub use export::{Encoding, write_evaluation_index, write_source};
pub use filters::SceneFilters;
pub use index::{EvaluationIndex, EvaluationItem};
pub use info::{SourceInfo, Spread};
pub use layout::{FileOptions, Layout, LayoutOptions, Opened, open_layout};
pub use ledger::{FrameSkip, Ledger, Skip};
pub use lens::Lens;
pub use loader::Prefetcher;
pub use normalize::{PoseRotation, PoseScale, SceneFrame};
pub use order::SceneOrder;
pub use sampler::BoundedSampler;
pub use split::Split;
pub use spread::spread_along_path;
pub use synthetic::{SyntheticConfig, SyntheticSource};
pub use test_scenes::TestScenes;
pub use undistort::Undistortion;
