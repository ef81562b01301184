//! Errors of the data crate: one variant per failure.

use std::path::{Path, PathBuf};

use clift_core::{BadConfig, CameraError};

/// Error of this crate. A message states the problem, the expected and the found value, and the path last.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DataError {
    /// A file could not be opened, read or written.
    #[error("{action} failed: {source}: {path}", path = path.display())]
    Io {
        /// Operation that failed, as a verb phrase ("reading the chunk").
        action: &'static str,
        /// Error of the operating system.
        source: std::io::Error,
        /// File.
        path: PathBuf,
    },
    /// A file is too large, or is a folder, a pipe or a device.
    #[error("bad file: {what}: {path}", path = path.display())]
    BadFile {
        /// Problem.
        what: String,
        /// File.
        path: PathBuf,
    },
    /// A camera cannot be used, or the cameras of a scene have no normalised frame.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// A pickle is malformed, larger than the limits, or uses an opcode that `torch.save` does not write.
    #[error("bad pickle: {what}: {path}", path = path.display())]
    BadPickle {
        /// Problem and its byte position.
        what: String,
        /// Archive of the pickle.
        path: PathBuf,
    },
    /// A pickle names a Python object that is not on the allow-list. Pickles are parsed, never executed.
    #[error("the pickle names the Python object `{name}`, which is not on the allow-list; no code was run: {path}", path = path.display())]
    RefusedGlobal {
        /// Module and name, such as `os.system`.
        name: String,
        /// Archive of the pickle.
        path: PathBuf,
    },
    /// A chunk is truncated, is not a ZIP archive, or violates the chunk format.
    #[error("bad chunk: {what}: {path}", path = path.display())]
    BadChunk {
        /// Problem, with the scene key if known.
        what: String,
        /// Chunk file.
        path: PathBuf,
    },
    /// A PyTorch checkpoint is truncated, is not a ZIP archive, or lacks a requested tensor.
    #[error("bad checkpoint: {what}: {path}", path = path.display())]
    BadCheckpoint {
        /// Problem, with the tensor's key if known.
        what: String,
        /// Checkpoint file.
        path: PathBuf,
    },
    /// An `index.json` or an evaluation index is malformed.
    #[error("bad index: {what}: {path}", path = path.display())]
    BadIndex {
        /// Problem.
        what: String,
        /// File.
        path: PathBuf,
    },
    /// A folder cannot take the output of a command: it holds other files, or was written with other options.
    #[error("the output folder cannot be used: {what}: {path}", path = path.display())]
    BadOutput {
        /// Problem and remedy.
        what: String,
        /// Folder, or the file in it.
        path: PathBuf,
    },
    /// A folder or file holds no scenes in a known layout, or none in the requested layout.
    #[error("no scenes found: {what}: {path}", path = path.display())]
    UnknownLayout {
        /// Expected files and the files found.
        what: String,
        /// Folder or file.
        path: PathBuf,
    },
    /// A scene of photos cannot be used: malformed cameras, an unknown camera model, or no images.
    #[error("bad scene: {what}: {path}", path = path.display())]
    BadScene {
        /// Problem, with its line, camera or image.
        what: String,
        /// Camera file or image file.
        path: PathBuf,
    },
    /// The end of an image file is missing.
    #[error("bad scene: the image is truncated: its {num_bytes} bytes have no end marker: {path}", path = path.display())]
    TruncatedImage {
        /// Bytes of the file.
        num_bytes: u64,
        /// Image file.
        path: PathBuf,
    },
    /// The data of an image ends early or is damaged in its middle.
    #[error("bad scene: the image is damaged: {what}: {path}", path = path.display())]
    DamagedImage {
        /// Problem.
        what: &'static str,
        /// Image file.
        path: PathBuf,
    },
    /// An image has another aspect ratio than its camera.
    #[error(
        "bad scene: the image is {width}x{height}, aspect ratio {:.3}, but its camera has {camera_aspect:.3}; the image may \
         have been rotated or cropped after the calibration: {path}",
        *width as f64 / *height as f64, path = path.display()
    )]
    WrongAspect {
        /// Columns of the image.
        width: usize,
        /// Rows of the image.
        height: usize,
        /// Aspect ratio of the camera.
        camera_aspect: f64,
        /// Image file.
        path: PathBuf,
    },
    /// A file of camera poses is malformed.
    #[error("bad poses: {what}: {path}", path = path.display())]
    BadPoses {
        /// Problem and the index of the pose.
        what: String,
        /// File.
        path: PathBuf,
    },
    /// A frame index is out of range.
    #[error("scene {key} has {num_frames} frames; frame {frame} (counted from 0) does not exist")]
    NoSuchFrame {
        /// Scene key.
        key: String,
        /// Requested frame index.
        frame: usize,
        /// Number of frames of the scene.
        num_frames: usize,
    },
    /// An image file is not a readable JPEG or PNG, or the image exceeds the size limit.
    #[error("frame {frame} of scene {key} cannot be decoded: {what}")]
    BadImage {
        /// Scene key.
        key: String,
        /// Frame index in the scene.
        frame: usize,
        /// Error of the decoder.
        what: String,
    },
    /// An image cannot be encoded.
    #[error("encoding a {width}x{height} image failed: {what}")]
    Encode {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// Error of the encoder.
        what: String,
    },
    /// A requested image size exceeds the size of the image file.
    #[error(
        "cannot make a {width}x{height} image from a {from_width}x{from_height} image: upscaling is not supported; lower the configured size"
    )]
    Upscale {
        /// Requested columns.
        width: usize,
        /// Requested rows.
        height: usize,
        /// Columns of the image file.
        from_width: usize,
        /// Rows of the image file.
        from_height: usize,
    },
    /// A frame of a scene cannot be used.
    #[error("frame {frame} of scene {key}: {source}")]
    InFrame {
        /// Scene key.
        key: String,
        /// Frame index in the scene.
        frame: usize,
        /// Cause.
        source: Box<DataError>,
    },
    /// A configuration value is invalid.
    #[error(transparent)]
    BadConfig(#[from] BadConfig),
    /// A scene has too few frames for the views to sample.
    #[error("not enough frames: {needed} needed, {got} in the scene")]
    NotEnoughFrames {
        /// Smallest sufficient number of frames.
        needed: usize,
        /// Number of frames of the scene.
        got: usize,
    },
    /// A scene index is out of range.
    #[error("the source has {num_scenes} scenes; scene {scene} (counted from 0) does not exist")]
    NoSuchScene {
        /// Requested scene index.
        scene: usize,
        /// Number of scenes of the source.
        num_scenes: usize,
    },
    /// All scenes of a split were skipped.
    #[error("no usable scene: {reason}")]
    NoScenes {
        /// Split and its skip report.
        reason: String,
    },
    /// No scene that was tried for a batch slot is usable.
    #[error(
        "no usable scene for slot {slot} of step {step} in {attempts} tries; the last, {key}, failed with: {reason}"
    )]
    NoUsableScene {
        /// Step of the batch.
        step: u64,
        /// Slot of the batch.
        slot: usize,
        /// Number of scenes tried.
        attempts: u32,
        /// Key of the last scene tried.
        key: String,
        /// Error of the last scene tried.
        reason: String,
    },
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
