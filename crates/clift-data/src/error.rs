//! Errors of the data crate: one variant per failure.

use std::path::{Path, PathBuf};

use clift_core::{BadConfig, CameraError};

/// Error of this crate. A message states the problem, the expected and the found value, and the path last.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the message of a variant says what its fields are")]
pub enum DataError {
    /// A file could not be opened, read or written.
    #[error("{action} failed: {source}: {path}", path = path.display())]
    Io { action: &'static str, source: std::io::Error, path: PathBuf },
    /// A file is too large, or is a folder, a pipe or a device.
    #[error("bad file: {what}: {path}", path = path.display())]
    BadFile { what: String, path: PathBuf },
    /// A camera cannot be used, or the cameras of a scene have no normalised frame.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// A pickle is malformed, larger than the limits, or uses an opcode that `torch.save` does not write.
    #[error("bad pickle: {what}: {path}", path = path.display())]
    BadPickle { what: String, path: PathBuf },
    /// A pickle names a Python object that is not on the allow-list. Pickles are parsed, never executed.
    #[error("the pickle names the Python object `{name}`, which is not on the allow-list; no code was run: {path}", path = path.display())]
    RefusedGlobal { name: String, path: PathBuf },
    /// A chunk is truncated, is not a ZIP archive, or violates the chunk format.
    #[error("bad chunk: {what}: {path}", path = path.display())]
    BadChunk { what: String, path: PathBuf },
    /// A PyTorch checkpoint is truncated, is not a ZIP archive, or lacks a requested tensor.
    #[error("bad checkpoint: {what}: {path}", path = path.display())]
    BadCheckpoint { what: String, path: PathBuf },
    /// An `index.json` or an evaluation index is malformed.
    #[error("bad index: {what}: {path}", path = path.display())]
    BadIndex { what: String, path: PathBuf },
    /// A folder cannot take the output of a command: it holds other files.
    #[error("the output folder cannot be used: {what}: {path}", path = path.display())]
    BadOutput { what: String, path: PathBuf },
    /// A folder or file holds no scenes in a known layout, or none in the requested layout.
    #[error("no scenes found: {what}: {path}", path = path.display())]
    UnknownLayout { what: String, path: PathBuf },
    /// A scene of photos cannot be used: malformed cameras, an unknown camera model, or no images.
    #[error("bad scene: {what}: {path}", path = path.display())]
    BadScene { what: String, path: PathBuf },
    /// An image or its mask is truncated or damaged, or has another aspect ratio than its camera; `reason` completes "a frame ..".
    #[error("bad scene: {what}: {path}", path = path.display())]
    BadPhoto { reason: &'static str, what: String, path: PathBuf },
    /// A file of camera poses is malformed.
    #[error("bad poses: {what}: {path}", path = path.display())]
    BadPoses { what: String, path: PathBuf },
    /// A frame index is out of range.
    #[error("scene {key} has {num_frames} frames; frame {frame} (counted from 0) does not exist")]
    NoSuchFrame { key: String, frame: usize, num_frames: usize },
    /// An image file is not a readable JPEG or PNG, or the image exceeds the size limit.
    #[error("frame {frame} of scene {key} cannot be decoded: {what}")]
    BadImage { key: String, frame: usize, what: String },
    /// An image cannot be encoded.
    #[error("encoding a {width}x{height} image failed: {what}")]
    Encode { width: usize, height: usize, what: String },
    /// A requested image size exceeds the size of the image file.
    #[error(
        "cannot make a {width}x{height} image from a {from_width}x{from_height} image: upscaling is not supported; lower the configured size"
    )]
    Upscale { width: usize, height: usize, from_width: usize, from_height: usize },
    /// A frame of a scene cannot be used.
    #[error("frame {frame} of scene {key}: {source}")]
    InFrame { key: String, frame: usize, source: Box<DataError> },
    /// A configuration value is invalid.
    #[error(transparent)]
    BadConfig(#[from] BadConfig),
    /// A scene has too few frames for the views to sample.
    #[error("not enough frames: {needed} needed, {got} in the scene")]
    NotEnoughFrames { needed: usize, got: usize },
    /// A scene index is out of range.
    #[error("the source has {num_scenes} scenes; scene {scene} (counted from 0) does not exist")]
    NoSuchScene { scene: usize, num_scenes: usize },
    /// All scenes of a split were skipped.
    #[error("no usable scene: {reason}")]
    NoScenes { reason: String },
    /// No scene that was tried for a batch slot is usable.
    #[error(
        "no usable scene for slot {slot} of step {step} in {attempts} tries; the last, {key}, failed with: {reason}"
    )]
    NoUsableScene { step: u64, slot: usize, attempts: u32, key: String, reason: String },
    /// A loader thread panicked.
    #[error(transparent)]
    WorkerPanic(#[from] WorkerPanic),
}

/// Panic of the code that prepares a batch. Other batches are unaffected.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("making the batch of step {step} panicked: {message}")]
pub struct WorkerPanic {
    /// Step of the batch.
    pub step: u64,
    /// Panic message.
    pub message: String,
}

impl DataError {
    /// Creates a [`CameraError::BadCamera`].
    pub(crate) fn bad_camera(what: String) -> Self {
        CameraError::BadCamera { what }.into()
    }

    /// Returns a function that names the frame of an error, for `map_err`.
    pub(crate) fn in_frame<E: Into<Self>>(key: &str, frame: usize) -> impl FnOnce(E) -> Self {
        move |source| Self::InFrame { key: key.to_owned(), frame, source: Box::new(source.into()) }
    }

    /// Returns a function that wraps an error of the operating system, for `map_err`.
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        move |source| Self::Io { action, source, path: path.to_path_buf() }
    }
}
