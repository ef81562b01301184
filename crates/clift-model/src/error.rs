//! Errors of models, their inputs and their files.

use std::path::PathBuf;

/// Errors of this crate: one variant per cause, the path last in the message.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the message of a variant says what its fields are")]
pub enum ModelError {
    #[error("`{key}` = {value}: {fix}")]
    BadConfig { key: &'static str, value: String, fix: String },
    #[error("{name}: expected {expected} values for the shape, got {got}")]
    WrongLength { name: &'static str, expected: usize, got: usize },
    #[error("{name} holds {value} at position {position}")]
    NotFinite { name: &'static str, value: f32, position: usize },
    #[error("an image of {width} x {height} does not divide into patches of {patch_size} x {patch_size}")]
    NotDivisible { width: usize, height: usize, patch_size: usize },
    #[error("bad clusters: {reason}")]
    BadClusters { reason: String },
    #[error("invalid ray of token {token}: origin {origin:?}, direction {direction:?}")]
    BadRay { token: usize, origin: [f64; 3], direction: [f64; 3] },
    #[error("device `{name}`: {reason}")]
    NoDevice { name: String, reason: String },
    #[error(
        "{what} of {num_views} context views would be one tensor of {bytes} bytes, and the device takes at most {limit} in \
         one: choose fewer context views"
    )]
    TensorTooLarge { what: String, bytes: u64, limit: u64, num_views: usize },
    #[error("reading values from the device failed: {reason}")]
    Device { reason: String },
    #[error("{reason}")]
    BadImage { reason: String },
    #[error("bad weights for {what}: {reason}; make the file with `{command}`: {path}", path = path.display())]
    BadWeights { what: &'static str, reason: String, command: &'static str, path: PathBuf },
    #[error("cannot {action} the scene: {reason}; {fix}: {path}", path = path.display())]
    SceneFile { action: &'static str, reason: String, fix: &'static str, path: PathBuf },
    #[error("the scene was made for the renderer {expected:.12}, this one is {got:.12}; give the run it was encoded with (--model RUN): {path}", path = path.display())]
    OtherRenderer { expected: String, got: String, path: PathBuf },
    #[error("{action} the weights failed: {reason}: {path}", path = path.display())]
    Weights { action: &'static str, reason: String, path: PathBuf },
    #[error(
        "{action} the token codec failed: {reason}; fit it again with `clift codec`: {path}",
        path = path.display()
    )]
    CodecFile { action: &'static str, reason: String, path: PathBuf },
    #[error("no token codec at {path}; fit it with `clift codec RUN`", path = path.display())]
    NoCodec { path: PathBuf },
    #[error("no trained model at {path}; run `clift train` first", path = path.display())]
    NoModel { path: PathBuf },
    #[error(
        "writing the model that ships with clift failed: {source}; set XDG_DATA_HOME to a folder that can be written, or \
         name another model: {path}",
        path = path.display()
    )]
    NotUnpacked { source: std::io::Error, path: PathBuf },
    #[error(
        "no config.toml next to {path} or in its parent directory: the network's sizes are unknown; give the run \
         directory or RUN/stage2/model.safetensors",
        path = path.display()
    )]
    NoConfig { path: PathBuf },
    #[error("reading the configuration failed: {reason}: {path}", path = path.display())]
    BadConfigFile { reason: String, path: PathBuf },
    #[error(
        "a PyTorch checkpoint must be imported first; run `clift import {path} --variant released-re10k -o DIR` (or \
         another variant) and give DIR instead: {path}",
        path = path.display()
    )]
    NotImported { path: PathBuf },
    #[error("`{text}` tokens: {reason}")]
    BadTokenCount { text: String, reason: String },
}

impl ModelError {
    /// Makes the error of values that cannot be read back from their device.
    pub fn device(error: impl std::fmt::Debug) -> Self {
        Self::Device { reason: format!("{error:?}") }
    }
}
