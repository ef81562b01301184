//! Errors of models, their inputs and their files.

use std::path::PathBuf;

/// Errors of this crate: one variant per cause, the path last in the message.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ModelError {
    /// Configuration value out of range.
    #[error("`{key}` = {value}: {fix}")]
    BadConfig {
        /// Dotted key, as in the TOML file.
        key: &'static str,
        /// The value found.
        value: String,
        /// The remedy.
        fix: String,
    },
    /// Host array whose length differs from the product of its shape.
    #[error("{name}: expected {expected} values for the shape, got {got}")]
    WrongLength {
        /// Name of the array.
        name: &'static str,
        /// Product of the shape.
        expected: usize,
        /// Length of the array.
        got: usize,
    },
    /// Host array that holds a NaN or an infinity.
    #[error("{name} holds {value} at position {position}")]
    NotFinite {
        /// Name of the array.
        name: &'static str,
        /// The value found.
        value: f32,
        /// Its index in the array.
        position: usize,
    },
    /// Image whose sides are not multiples of the patch size.
    #[error("an image of {width} x {height} does not divide into patches of {patch_size} x {patch_size}")]
    NotDivisible {
        /// Width in pixels.
        width: usize,
        /// Height in pixels.
        height: usize,
        /// Side of a patch in pixels.
        patch_size: usize,
    },
    /// Invalid cluster indices.
    #[error("bad clusters: {reason}")]
    BadClusters {
        /// The contradiction and its indices.
        reason: String,
    },
    /// Ray of a token that is not finite, or whose direction has length zero.
    #[error("invalid ray of token {token}: origin {origin:?}, direction {direction:?}")]
    BadRay {
        /// Index of the token.
        token: usize,
        /// Origin of the ray.
        origin: [f64; 3],
        /// Direction of the ray.
        direction: [f64; 3],
    },
    /// Unknown device name, or a device that cannot be opened.
    #[error("device `{name}`: {reason}")]
    NoDevice {
        /// The device name.
        name: String,
        /// The cause and the remedy.
        reason: String,
    },
    /// Failure to read values back from a device.
    #[error("reading values from the device failed: {reason}")]
    Device {
        /// The error of the device.
        reason: String,
    },
    /// Image with another number of values than its target or shape, too small for a metric, or with a NaN or an infinity.
    #[error("{reason}")]
    BadImage {
        /// The problem.
        reason: String,
    },
    /// Weight file of a metric or loss that is not usable.
    #[error("bad weights for {what}: {reason}; make the file with `{command}`: {path}", path = path.display())]
    BadWeights {
        /// The metric or loss.
        what: &'static str,
        /// The problem.
        reason: String,
        /// Command that makes the file.
        command: &'static str,
        /// The file.
        path: PathBuf,
    },
    /// Scene file that cannot be written, or that is damaged or of another format.
    #[error("cannot {action} the scene: {reason}; {fix}: {path}", path = path.display())]
    SceneFile {
        /// The operation: `use` or `write`.
        action: &'static str,
        /// The cause.
        reason: String,
        /// The remedy.
        fix: &'static str,
        /// The scene file.
        path: PathBuf,
    },
    /// Weights of another renderer than the one the scene was encoded for.
    #[error("the scene was made for the renderer {expected:.12}, this one is {got:.12}; give the run it was encoded with (--model RUN): {path}", path = path.display())]
    OtherRenderer {
        /// Hash in the scene.
        expected: String,
        /// Hash of the weights.
        got: String,
        /// The weight file.
        path: PathBuf,
    },
    /// Failure to read or write a weight file.
    #[error("{action} the weights failed: {reason}: {path}", path = path.display())]
    Weights {
        /// The operation: `reading` or `writing`.
        action: &'static str,
        /// The cause.
        reason: String,
        /// The weight file.
        path: PathBuf,
    },
    /// Failure to read or write the token codec of a model.
    #[error(
        "{action} the token codec failed: {reason}; fit it again with `clift codec`: {path}",
        path = path.display()
    )]
    CodecFile {
        /// The operation: `reading` or `writing`.
        action: &'static str,
        /// The cause.
        reason: String,
        /// The file.
        path: PathBuf,
    },
    /// Model without a token codec.
    #[error("no token codec at {path}; fit it with `clift codec RUN`", path = path.display())]
    NoCodec {
        /// The expected file.
        path: PathBuf,
    },
    /// Path without the weights of a trained model.
    #[error("no trained model at {path}; run `clift train` first", path = path.display())]
    NoModel {
        /// The expected weight file.
        path: PathBuf,
    },
    /// The model inside the program could not be written to the data folder of the user.
    #[error(
        "writing the model that ships with clift failed: {source}; set XDG_DATA_HOME to a folder that can be written, or \
         name another model: {path}",
        path = path.display()
    )]
    NotUnpacked {
        /// Error of the operating system.
        source: std::io::Error,
        /// Folder of the model.
        path: PathBuf,
    },
    /// Weight file without the config of its run.
    #[error(
        "no config.toml next to {path} or in its parent directory: the network's sizes are unknown; give the run \
         directory or RUN/stage2/model.safetensors",
        path = path.display()
    )]
    NoConfig {
        /// The weight file.
        path: PathBuf,
    },
    /// Failure to read the config of a trained model.
    #[error("reading the configuration failed: {reason}: {path}", path = path.display())]
    BadConfigFile {
        /// The cause.
        reason: String,
        /// The config file.
        path: PathBuf,
    },
    /// PyTorch checkpoint in place of a trained model of clift.
    #[error(
        "a PyTorch checkpoint must be imported first; run `clift import {path} --variant released-re10k -o DIR` (or \
         another variant) and give DIR instead: {path}",
        path = path.display()
    )]
    NotImported {
        /// The checkpoint.
        path: PathBuf,
    },
    /// Token count that is malformed or that the scene does not have.
    #[error("`{text}` tokens: {reason}")]
    BadTokenCount {
        /// The value found.
        text: String,
        /// The cause, with the tokens of the scene.
        reason: String,
    },
}

impl ModelError {
    /// Makes the error of values that cannot be read back from their device.
    pub fn device(error: impl std::fmt::Debug) -> Self {
        Self::Device { reason: format!("{error:?}") }
    }
}
