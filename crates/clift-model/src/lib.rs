//! Compressive light-field tokens (`CLiFT`, `NeurIPS` 2025) in Burn: tensors in, tensors out.
//!
//! The [`Encoder`] turns posed context views into light-field tokens, latent K-means ([`KMeans`]) groups the tokens, and
//! the [`Condenser`] writes every group into its centroid. To render, the [`Selector`] selects the tokens nearest to a
//! target camera and the [`Renderer`] decodes an image from the selected tokens. [`Network`] holds them.
//!
//! ```
//! use clift_core::{Camera, ClipViews, Intrinsics, Pose};
//! use clift_model::{Cameras, Network, DeviceName, KMeans, ModelConfig, Views};
//!
//! let device = DeviceName::Flex.open()?;
//! let config = ModelConfig { dim: 16, num_heads: 2, feed_forward_dim: 32, ..ModelConfig::default() };
//! let model = Network::new(&config, 0, &device);
//!
//! // One scene of two gray views of 16 x 16 pixels, both at the origin.
//! let (width, height) = (16, 16);
//! let camera = Camera { c2w: Pose::IDENTITY, intrinsics: Intrinsics { fx: 16.0, fy: 16.0, cx: 8.0, cy: 8.0 } };
//! let (images, cameras) = (vec![128; 2 * height * width * 3], vec![camera; 2]);
//! let views = Views::upload(&[&ClipViews { width, height, images, cameras, frame_index: vec![0, 1] }], &device)?;
//!
//! // All 8 tokens of the scene, condensed into 4 and rendered from the second camera's pose.
//! let tokens = model.encode(&views);
//! let clusters = KMeans::default().fit(tokens.values.clone(), 4, &[0])?.clusters.upload(&device);
//! let tokens = model.compress(tokens, &clusters);
//! let target = Cameras::of_views(&[camera], height, width, &device)?;
//! let image = model.render(tokens, &target);
//! assert_eq!(image.dims(), [1, 1, 16, 16, 3]);
//! # Ok::<(), clift_model::ModelError>(())
//! ```
#![cfg_attr(
    feature = "ndarray",
    expect(
        deprecated,
        reason = "Burn deprecates ndarray in favor of flex; clift keeps ndarray as an independent reference"
    )
)]

mod cost;
mod device;
mod error;
mod metrics;
mod names;
mod network;
mod ops;
#[cfg(test)]
mod testing;
mod tokens;
mod views;
mod weights;

// Errors, and enums by name
pub use error::ModelError;
pub use names::{names, parse_value, parse_variant};
// Devices
pub use clift_kernels::InstructionSet;
pub use device::adapter::{ADAPTER_VARIABLE, Adapter, adapters, max_tensor_bytes, product_instructions, used_adapter};
pub use device::ledger::{KernelLaunches, observe_kernels, reserved_bytes};
pub use device::name::DeviceName;
pub use ops::precision::{Precision, has_threads, map_in_threads};
// Images and cameras
pub use views::patch_grids::PatchGrids;
pub use views::rays::RayFrame;
pub use views::rays::plucker;
pub use views::upload::{Cameras, Views, upload_images};
// Tokens: counts, clusters, selection
pub use tokens::clusters::{ClusterIndex, Clusters, SceneClusters};
pub use tokens::count::TokenCount;
pub use tokens::grouping::Grouping;
pub use tokens::kind::TokenKind;
pub use tokens::kmeans::fit::{KMeans, KMeansFit};
pub use tokens::selection::rules::{SelectionPreset, SelectionRules};
pub use tokens::selection::selector::Selector;
pub use tokens::selection::token_ray::TokenRay;
// Networks
pub use network::architecture::{Architecture, CameraEncoding, CliftVariant};
pub use network::condenser::Condenser;
pub use network::config::{CondenserConfig, ModelConfig};
pub use network::encoder::Encoder;
pub use network::model::Network;
pub use network::render_tokens::{KeyValueCache, RenderTokens};
pub use network::renderer::Renderer;
pub use network::tokens::Tokens;
// Operations of the networks
pub use ops::attention::cross_sdpa;
pub use ops::cluster_attention::cluster_attention;
pub use ops::linear::linear;
pub use ops::matmul::{matmul_without_gradient, peak_flops};
pub use ops::optimizer::{AdamWFactors, fused_adamw, fused_gradient_norm};
// Parameters, multiply-accumulates and memory of a network
pub use cost::largest_tensor::{kmeans_values, largest_tensors};
pub use cost::macs::{FlopConvention, Macs};
pub use cost::memory::{InferenceSizes, Segment, UpdateSizes, inference_bytes, render_bytes, update_bytes};
pub use cost::parameters::Parameters;
pub use cost::scene_sizes::SceneSizes;
pub use network::layers::Part;
// Metrics of images, and the perceptual loss
pub use metrics::image_metrics::{SSIM_MIN_SIZE_PX, check_images, psnr, psnr_of_mse, sharpness, ssim};
pub use metrics::lpips::{LPIPS_COMMAND, LPIPS_MIN_SIZE_PX, Lpips, LpipsFeatures};
pub use metrics::perceptual::{PERCEPTUAL_COMMAND, PERCEPTUAL_MIN_SIZE_PX, Perceptual};
pub use metrics::vgg::VggShape;
// Weight files and trained models
pub use weights::file::{
    first_not_f32, load_adapted, load_part, save_part, save_part_f16, save_weights, sorted_header,
};
pub use weights::hash::{renderer_hash, weights_hash};
pub use weights::model_path::{ModelPath, check_condenser, check_sizes, refuse_checkpoint};
pub use weights::network_adapter::NetworkAdapter;
pub use weights::published_keys::{PERCEPTUAL_PREFIX, PREFIX, PublishedTensor, canonical_key, published_tensors};
pub use weights::published_sizes::{InferredConfig, infer_config};
pub use weights::shipped_model::{SHIPPED_MODEL, find_shipped, is_shipped};
pub use weights::trained_model::{TrainedModel, open_renderer};
