//! Compressive light-field tokens in Burn: the paper, tensors in, tensors out.
//!
//! Posed context views become light-field tokens ([`Encoder`]), latent K-means ([`KMeans`]) picks
//! `num_storage_tokens` of them, the neural [`Condenser`] writes the rest into those, and the
//! [`Renderer`] draws a target view from the result. [`Clift`] holds the three networks.
//!
//! Modules take a [`burn::tensor::Device`]; all devices are named in [`device`].

pub mod adapter;
pub mod architecture;
pub mod attention;
mod autodiff;
pub mod block;
pub mod camera;
pub mod cluster_attention;
pub mod clusters;
pub mod condenser;
pub mod config;
pub mod cost;
pub mod device;
pub mod encoder;
pub mod error;
pub mod feed_forward;
mod files;
mod flex;
pub mod hash;
pub mod init;
pub mod interchange;
pub mod kmeans;
pub mod layer_norm;
mod layers;
pub mod lift_norm;
pub mod linear;
mod mac_counter;
pub mod model;
pub mod model_path;
pub mod names;
pub mod patch;
pub mod patchwise;
pub mod precision;
pub mod qk_norm;
pub mod rays;
pub mod render_budget;
pub mod renderer;
pub mod scene;
pub mod scene_model;
pub mod select;
#[cfg(test)]
pub(crate) mod testing;
pub mod token_count;
pub mod trained_model;
pub mod viewer;
pub mod views;
pub mod weights;

pub use architecture::Variant;
pub use camera::ViewCamera;
pub use clift_kernels::InstructionSet;
pub use clusters::{ClusterIndex, Clusters, SceneClusters};
pub use condenser::Condenser;
pub use config::CondenserConfig;
pub use config::ModelConfig;
pub use cost::Convention;
pub use cost::Macs;
pub use cost::Parameters;
pub use cost::SceneSizes;
pub use encoder::Encoder;
pub use error::ModelError;
pub use init::Init;
pub use kmeans::{KMeans, total_variance};
pub use layers::Part;
pub use lift_norm::LiftNorm;
pub use model::Clift;
pub use model_path::ModelPath;
pub use patchwise::{Grouping, tile_clusters};
pub use precision::Precision;
pub use render_budget::RenderBudget;
pub use renderer::{RenderTokens, Renderer, SceneMemory};
pub use scene::{Scene, TokenKind, TokenStorage, WorldFrame, check_destination};
pub use scene_model::SceneModel;
pub use select::{Preset, Rules, Selector, TokenRay};
pub use token_count::TokenCount;
pub use trained_model::TrainedModel;
pub use viewer::{Drawn, Viewer};
pub use views::{Cameras, Views};
