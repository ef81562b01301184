//! Errors of models, their inputs and their files.

use std::path::PathBuf;

/// Errors of this crate: one variant per cause, the path last in the message.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the message of a variant says what its fields are")]
pub enum ModelError {
    /// Configuration value out of range.
    #[error("`{key}` = {value}: {fix}")]
    BadConfig { key: &'static str, value: String, fix: String },
    /// Host array whose length differs from the product of its shape.
    #[error("{name}: expected {expected} values for the shape, got {got}")]
    WrongLength { name: &'static str, expected: usize, got: usize },
    /// Host array that holds a NaN or an infinity.
    #[error("{name} holds {value} at position {position}")]
    NotFinite { name: &'static str, value: f32, position: usize },
    /// Image whose sides are not multiples of the patch size.
    #[error("an image of {width} x {height} does not divide into patches of {patch_size} x {patch_size}")]
    NotDivisible { width: usize, height: usize, patch_size: usize },
    /// Invalid cluster indices.
    #[error("bad clusters: {reason}")]
    BadClusters { reason: String },
    /// Ray of a token that is not finite, or whose direction has length zero.
    #[error("invalid ray of token {token}: origin {origin:?}, direction {direction:?}")]
    BadRay { token: usize, origin: [f64; 3], direction: [f64; 3] },
    /// Unknown device name, or a device that cannot be opened.
    #[error("device `{name}`: {reason}")]
    NoDevice { name: String, reason: String },
    /// Failure to read values back from a device.
    #[error("reading values from the device failed: {reason}")]
    Device { reason: String },
    /// Image with another number of values than its target or shape, too small for a metric, or with a NaN or an infinity.
    #[error("{reason}")]
    BadImage { reason: String },
    /// Weight file of a metric or loss that is not usable.
    #[error("bad weights for {what}: {reason}; make the file with `{command}`: {path}", path = path.display())]
    BadWeights { what: &'static str, reason: String, command: &'static str, path: PathBuf },
    /// Scene file that cannot be written, or that is damaged or of another format.
    #[error("cannot {action} the scene: {reason}; {fix}: {path}", path = path.display())]
    SceneFile { action: &'static str, reason: String, fix: &'static str, path: PathBuf },
    /// Weights of another renderer than the one the scene was encoded for.
    #[error("the scene was made for the renderer {expected:.12}, this one is {got:.12}; give the run it was encoded with (--model RUN): {path}", path = path.display())]
    OtherRenderer { expected: String, got: String, path: PathBuf },
    /// Failure to read or write a weight file.
    #[error("{action} the weights failed: {reason}: {path}", path = path.display())]
    Weights { action: &'static str, reason: String, path: PathBuf },
    /// Failure to read or write the token codec of a model.
    #[error(
        "{action} the token codec failed: {reason}; fit it again with `clift codec`: {path}",
        path = path.display()
    )]
    CodecFile { action: &'static str, reason: String, path: PathBuf },
    /// Model without a token codec.
    #[error("no token codec at {path}; fit it with `clift codec RUN`", path = path.display())]
    NoCodec { path: PathBuf },
    /// Path without the weights of a trained model.
    #[error("no trained model at {path}; run `clift train` first", path = path.display())]
    NoModel { path: PathBuf },
    /// The model inside the program could not be written to the data folder of the user.
    #[error(
        "writing the model that ships with clift failed: {source}; set XDG_DATA_HOME to a folder that can be written, or \
         name another model: {path}",
        path = path.display()
    )]
    NotUnpacked { source: std::io::Error, path: PathBuf },
    /// Weight file without the config of its run.
    #[error(
        "no config.toml next to {path} or in its parent directory: the network's sizes are unknown; give the run \
         directory or RUN/stage2/model.safetensors",
        path = path.display()
    )]
    NoConfig { path: PathBuf },
    /// Failure to read the config of a trained model.
    #[error("reading the configuration failed: {reason}: {path}", path = path.display())]
    BadConfigFile { reason: String, path: PathBuf },
    /// PyTorch checkpoint in place of a trained model of clift.
    #[error(
        "a PyTorch checkpoint must be imported first; run `clift import {path} --variant released-re10k -o DIR` (or \
         another variant) and give DIR instead: {path}",
        path = path.display()
    )]
    NotImported { path: PathBuf },
    /// Token count that is malformed or that the scene does not have.
    #[error("`{text}` tokens: {reason}")]
    BadTokenCount { text: String, reason: String },
}

impl ModelError {
    /// Makes the error of values that cannot be read back from their device.
    pub fn device(error: impl std::fmt::Debug) -> Self {
        Self::Device { reason: format!("{error:?}") }
    }
}
