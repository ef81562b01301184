//! Scenes of compressive light-field tokens: encode captured images, store the tokens in a file, render views from it.
//!
//! [`encode_scene`] does what `clift encode` does: it encodes images, writes the file and checks a rendering. Its steps:
//! [`encode`] compresses images of a scene to a [`Scene`], [`Scene::write`] stores its tokens in a number format and
//! [`Scene::write_coded`] with the [`TokenCodec`] of the model, which [`fit_codec`] fits on training scenes.
//! [`SceneRenderer`] renders views, and [`CheckedView`] compares a rendering with a photo.
//!
//! The example `encode_and_render` encodes a folder of photos and renders a view.

mod check;
mod codec;
mod encode;
mod error;
mod scene;
mod tensors;
#[cfg(test)]
mod testing;

// Errors
pub use error::SceneError;
// Encode images
pub use encode::contexts::{ContextChoice, Contexts, EncodeOptions};
pub use encode::encode::{EncodedScene, encode};
pub use encode::encode_scene::{SceneOptions, WrittenScene, encode_scene};
pub use encode::names::{find_scene, frame_positions};
pub use encode::photo_size::photo_size;
// Scene files, and rendering from them
pub use scene::check::MAX_SIDE_PX;
pub use scene::frame_size::check_frames;
pub use scene::scene::{ContextGroup, Scene, scene_file_bytes};
pub use scene::scene_renderer::{RenderedView, SceneRenderer, frame_bytes, frames_per_call, load_renderer};
pub use scene::token_coding::{CodedLoss, TokenCoding, TokenFormat};
pub use scene::write::check_output_path;
// A check of a scene, and the baselines of renderings
pub use check::{CheckedView, MIN_CONTEXT_PSNR, mean_image, nearest_image, view_image};
// The coder of tokens in scene files
pub use codec::fit::{CodecOptions, fit_codec};
pub use codec::token_codec::TokenCodec;
