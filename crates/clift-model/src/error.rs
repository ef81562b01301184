//! What can go wrong with a model, its input or its weights, one documented variant per failure.

use std::path::PathBuf;

/// A failure of this crate. A message says what, where, expected and got, with the path last.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ModelError {
    /// A configuration value is out of its range.
    #[error("`{key}` = {value}: {fix}")]
    BadConfig {
        /// Dotted key, as in the TOML file.
        key: &'static str,
        /// The value found.
        value: String,
        /// What to write instead.
        fix: String,
    },
    /// A host array does not have the length its shape asks for.
    #[error("{what}: expected {expected} values for the shape, got {got}")]
    WrongLength {
        /// Which array.
        what: &'static str,
        /// Product of the shape.
        expected: usize,
        /// Length of the array.
        got: usize,
    },
    /// A host array holds a NaN or an infinity.
    #[error("{what} holds {value} at position {position}")]
    NotFinite {
        /// Which array.
        what: &'static str,
        /// The value found.
        value: f32,
        /// Its index in the array.
        position: usize,
    },
    /// An image does not divide into patches.
    #[error("an image of {width} x {height} does not divide into patches of {patch_size} x {patch_size}")]
    NotDivisible {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// Side of a patch.
        patch_size: usize,
    },
    /// Cluster indices contradict each other.
    #[error("bad clusters: {what}")]
    BadClusters {
        /// The contradiction, with the indices that show it.
        what: String,
    },
    /// A token's ray is not finite, or its direction has no length.
    #[error("the ray of token {token} cannot be used: from {origin:?} along {direction:?}")]
    BadRay {
        /// Position of the token.
        token: usize,
        /// Where the ray starts.
        origin: [f64; 3],
        /// Where it goes.
        direction: [f64; 3],
    },
    /// A device name is unknown, or this build does not have it.
    #[error("device `{name}`: {reason}")]
    NoDevice {
        /// The name asked for.
        name: String,
        /// Why it cannot be had, and what would help.
        reason: String,
    },
    /// A picture could not be read back from its device.
    #[error("reading a picture from its device failed: {reason}")]
    Device {
        /// The device's reason.
        reason: String,
    },
    /// A scene file could not be written, or is not one to draw from.
    #[error("cannot {action} the scene: {reason}; {fix}: {path}", path = path.display())]
    SceneFile {
        /// What was being done ("use", "write").
        action: &'static str,
        /// Why it cannot.
        reason: String,
        /// What to do about it.
        fix: &'static str,
        /// The file.
        path: PathBuf,
    },
    /// A scene is to be drawn with weights it was not made for.
    #[error("the scene was made for the renderer {expected:.12}, this one is {got:.12}; give the run it was encoded with (--model RUN): {path}", path = path.display())]
    OtherRenderer {
        /// Hash in the scene.
        expected: String,
        /// Hash of the weights.
        got: String,
        /// The weights.
        path: PathBuf,
    },
    /// A weight file could not be read or written.
    #[error("{action} the weights failed: {reason}: {path}", path = path.display())]
    Weights {
        /// What was being done ("reading", "writing").
        action: &'static str,
        /// The reason.
        reason: String,
        /// The file.
        path: PathBuf,
    },
    /// No weights are found where a trained model is expected.
    #[error("no trained model at {path}; run `clift train` first", path = path.display())]
    NoModel {
        /// The weight file that was looked for.
        path: PathBuf,
    },
    /// A weight file lies away from the run that made it.
    #[error(
        "there is no config.toml beside it or above it, which says what model it holds; give the run directory, or \
         RUN/stage2/model.safetensors: {path}",
        path = path.display()
    )]
    NoConfig {
        /// The weight file.
        path: PathBuf,
    },
    /// The config beside a weight file could not be read.
    #[error("reading the configuration failed: {reason}: {path}", path = path.display())]
    BadConfigFile {
        /// The reason.
        reason: String,
        /// The config.
        path: PathBuf,
    },
    /// A PyTorch checkpoint was given where a model of this program is expected.
    #[error(
        "a checkpoint of PyTorch must be imported first: run `clift import {path} --variant released-re10k -o DIR` (or \
         another variant) and give DIR instead: {path}",
        path = path.display()
    )]
    NotImported {
        /// The checkpoint.
        path: PathBuf,
    },
    /// A scene does not have that number or share of tokens.
    #[error("`{text}` tokens: {reason}")]
    BadTokenCount {
        /// The value found.
        text: String,
        /// Why the scene does not have it, and what it has.
        reason: String,
    },
}
