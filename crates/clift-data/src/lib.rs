//! Files in, clips out: data sets and captures in every layout, synthetic scenes, view samplers and the loader.
//!
//! A clip holds the context and target images of one scene with their normalised cameras. This crate does not depend on
//! Burn: clips are plain host arrays ([`ClipViews`](clift_core::ClipViews)), which `clift_model::Views::upload` copies to a device.
//!
//! ```
//! use clift_data::{ClipReader, DataConfig, Split, ViewIndices, open_dataset};
//!
//! let config = DataConfig { width: 32, height: 24, ..DataConfig::default() }; // synthetic rooms
//! let opened = open_dataset(&config, Split::Train, &mut |_, _| ())?;
//! println!("{}", opened.report); // skipped scenes and frames
//!
//! let reader = ClipReader { source: opened.source, options: config.clip_options() };
//! let clip = reader.read(0, &ViewIndices { context: vec![0, 8], target: vec![4] })?;
//! assert_eq!((clip.context.num_views(), clip.target.num_views()), (2, 1));
//! # Ok::<(), clift_data::DataError>(())
//! ```

mod config;
mod dataset;
mod error;
mod files;
mod geometry;
mod image;
mod sampling;
mod scene_source;
mod skip_report;
mod sources;
mod synthetic;
#[cfg(test)]
mod testing;
mod tools;
mod torch;

// Opening a data set.
pub use config::DataConfig;
pub use dataset::{half_size_reader, open_dataset, open_training_dataset, resized_reader};
pub use error::{DataError, WorkerPanic};
pub use scene_source::{SceneSource, Split, is_held_out};
pub use skip_report::{SkipReport, SkippedFrame, SkippedScene};

// Layouts on disk, and synthetic scenes.
pub use sources::chunks::chunk_source::ChunkSource;
pub use sources::chunks::table::ScanProgress;
pub use sources::chunks::writer::{SceneRecord, write_chunks};
pub use sources::dataset_root::DatasetRoot;
pub use sources::filters::SceneFilters;
pub use sources::keys::is_dl3dv_key;
pub use sources::kind::SourceKind;
pub use sources::open::{OpenedSource, open_source};
pub use sources::options::{FileOptions, SourceOptions};
pub use sources::photos::photo::PosesFrom;
pub use sources::subset::SceneSubset;
pub use sources::test_scenes::TestScenes;
pub use synthetic::config::{Look, SyntheticConfig};
pub use synthetic::source::SyntheticSource;

// Clips and batches.
pub use sampling::clip::{Clip, ViewIndices};
pub use sampling::clip_reader::{ClipOptions, ClipReader};
pub use sampling::evaluation_index::{EvaluationIndex, EvaluationItem, even_views, even_views_of};
pub use sampling::prefetcher::Prefetcher;
pub use sampling::training_clips::TrainingClips;
pub use sampling::view_sampler::{ViewSampler, Window};

// Lenses, files of poses, and measures on poses.
pub use geometry::lens::Lens;
pub use geometry::overlap::overlap;
pub use geometry::path_spread::contexts_along_path;
pub use geometry::pose_file::read_poses;

// Images.
pub use image::codec::{decode_image, encode_jpeg, encode_png, image_size};
pub use image::fit::fit_image;
pub use image::undistort::Undistortion;

// Tools for data sets: describe, check, index.
pub use files::hash::hash_file;
pub use tools::check::result::{FrameCheck, PairCheck, SceneCheck, Verdict};
pub use tools::check::scene::{check_scene, note_skipped_frames, skipped_scenes};
pub use tools::export::{read_scene, write_evaluation_index};
pub use tools::info::SourceInfo;
pub use tools::overlap_index::{OverlapOptions, write_overlap_index};

// PyTorch files, read without executing them.
pub use torch::pickle::Pickle;
pub use torch::state_dict::{StateDict, write_state_dict};
pub use torch::values::ElementType;
