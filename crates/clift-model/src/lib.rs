//! Compressive light-field tokens in Burn: the paper, tensors in, tensors out.
//!
//! Posed context views become light-field tokens ([`Encoder`]), latent K-means ([`KMeans`]) picks
//! `num_storage_tokens` of them, the neural [`Condenser`] writes the rest into those, and the
//! [`Renderer`] draws a target view from the result. [`Clift`] holds the three networks.
//!
//! Modules take a [`burn::tensor::Device`]; all devices are named in [`device`].

mod cost;
mod device;
mod error;
mod files;
mod names;
mod network;
mod ops;
mod scene;
#[cfg(test)]
mod testing;
mod tokens;
mod views;
mod weights;

pub use clift_kernels::InstructionSet;
pub use cost::largest_tensor::{kmeans_values, largest_tensors};
pub use cost::macs::{FlopConvention, Macs};
pub use cost::memory::{InferenceSizes, Segment, UpdateSizes, inference_bytes, render_bytes, update_bytes};
pub use cost::parameters::Parameters;
pub use cost::scene_sizes::SceneSizes;
pub use device::adapter::{ADAPTER_VARIABLE, Adapter, Limits, adapters, max_tensor_bytes};
pub use device::name::DeviceName;
pub use error::ModelError;
pub use names::parse_value;
pub use network::architecture::CliftVariant;
pub use network::blocks::attention::SelfAttention;
pub use network::blocks::block::{DecoderBlock, EncoderBlock};
pub use network::blocks::feed_forward::{Activation, FeedForward};
pub use network::blocks::norms::LiftNorm;
pub use network::clift::Clift;
pub use network::condenser::Condenser;
pub use network::config::{CondenserConfig, ModelConfig};
pub use network::encoder::Encoder;
pub use network::init::Init;
pub use network::layers::Part;
pub use network::render_tokens::{KeyValueCache, RenderTokens};
pub use network::renderer::Renderer;
pub use network::scene_model::SceneModel;
pub use ops::attention::composed::MAX_SCORES;
pub use ops::attention::sdpa::{cross_sdpa, self_sdpa};
pub use ops::cluster_attention::operation::cluster_attention;
pub use ops::linear::{gelu_linear, linear, norm_linear};
pub use ops::precision::Precision;
pub use scene::check::MAX_SIDE_PX;
pub use scene::render_budget::RenderBudget;
pub use scene::scene::{Scene, SceneNormalization, scene_file_bytes};
pub use scene::scene_renderer::{RenderedView, SceneRenderer, frames_per_call, load_renderer};
pub use scene::token_format::TokenFormat;
pub use scene::write::check_output_path;
pub use tokens::clusters::{ClusterIndex, Clusters, SceneClusters};
pub use tokens::count::TokenCount;
pub use tokens::kind::TokenKind;
pub use tokens::kmeans::fit::{KMeans, KMeansFit, total_variance};
pub use tokens::selection::rules::{SelectionPreset, SelectionRules};
pub use tokens::selection::selector::Selector;
pub use tokens::selection::token_ray::TokenRay;
pub use tokens::tiles::{Grouping, tile_clusters};
pub use views::camera::ViewCamera;
pub use views::patch::{patchify, unpatchify};
pub use views::rays::plucker;
pub use views::upload::{Cameras, Views, upload_images};
pub use weights::file::{first_not_f32, load_part, save_part, save_weights, sorted_header};
pub use weights::hash::weights_hash;
pub use weights::model_path::{ModelPath, check_heads, refuse_checkpoint};
pub use weights::published_keys::{
    CONVOLUTIONS, PERCEPTUAL_PREFIX, PREFIX, PROJECTIONS, PublishedTensor, canonical_key, published_tensors,
};
pub use weights::published_sizes::{InferredConfig, infer_config};
pub use weights::trained_model::TrainedModel;
