//! What can go wrong between a file and a clip, one documented variant per failure.

use std::path::{Path, PathBuf};

/// A failure of this crate. A message says what, where, expected and got, with the path last.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DataError {
    /// A file could not be opened, read or written.
    #[error("{action} failed: {source}: {path}", path = path.display())]
    Io {
        /// What was being done, as a verb phrase ("reading the chunk").
        action: &'static str,
        /// The operating system's reason.
        source: std::io::Error,
        /// The file.
        path: PathBuf,
    },
    /// A camera holds a NaN or an infinity, or its rotation is not one.
    #[error("bad camera: {what}")]
    BadCamera {
        /// What is wrong with it, with the number that shows it.
        what: String,
    },
    /// A pickle is malformed, larger than the limits, or uses an opcode that `torch.save` does not write.
    #[error("bad pickle: {what}: {path}", path = path.display())]
    BadPickle {
        /// What is wrong with it, and at which byte.
        what: String,
        /// The archive that holds it.
        path: PathBuf,
    },
    /// A pickle names a Python object that is not on the allow-list. Nothing of it was run.
    #[error("the pickle asks for the Python object `{name}`, which is not allowed; nothing was run: {path}", path = path.display())]
    RefusedGlobal {
        /// Module and name, as `os.system`.
        name: String,
        /// The archive that holds it.
        path: PathBuf,
    },
    /// A chunk is truncated, not an archive, or does not hold what the chunk format says.
    #[error("bad chunk: {what}: {path}", path = path.display())]
    BadChunk {
        /// What is wrong with it, with the scene key where there is one.
        what: String,
        /// The chunk.
        path: PathBuf,
    },
    /// A PyTorch checkpoint is truncated, not an archive, or does not hold the tensors that are asked for.
    #[error("bad checkpoint: {what}: {path}", path = path.display())]
    BadCheckpoint {
        /// What is wrong with it, with the key where there is one.
        what: String,
        /// The checkpoint.
        path: PathBuf,
    },
    /// An `index.json` or evaluation index does not have the expected form.
    #[error("bad index: {what}: {path}", path = path.display())]
    BadIndex {
        /// What is wrong with it.
        what: String,
        /// The file.
        path: PathBuf,
    },
    /// A folder or file holds scenes in no layout that is known, or not in the one asked for.
    #[error("no scenes found: {what}: {path}", path = path.display())]
    UnknownLayout {
        /// What was looked for, and what there is.
        what: String,
        /// The folder or file.
        path: PathBuf,
    },
    /// A scene of photos cannot be used: its cameras are malformed, of an unknown model or without pictures.
    #[error("bad scene: {what}: {path}", path = path.display())]
    BadScene {
        /// What is wrong with it, with the line, camera or picture.
        what: String,
        /// The file that holds the cameras, or the picture.
        path: PathBuf,
    },
    /// A file of camera poses does not have the expected form.
    #[error("bad poses: {what}: {path}", path = path.display())]
    BadPoses {
        /// What is wrong with it, with the position of the pose.
        what: String,
        /// The file.
        path: PathBuf,
    },
    /// A scene is not in the evaluation index, not even as an unused entry.
    #[error("scene {key} is not in the evaluation index: {path}", path = path.display())]
    MissingIndexKey {
        /// Key of the scene.
        key: String,
        /// The index file.
        path: PathBuf,
    },
    /// A frame was asked for that the scene does not have.
    #[error("scene {key} has {num_frames} frames, so there is no frame {frame} (counted from 0)")]
    NoSuchFrame {
        /// Key of the scene.
        key: String,
        /// Position asked for.
        frame: usize,
        /// How many frames the scene has.
        num_frames: usize,
    },
    /// The bytes of a frame are no readable JPEG or PNG, or the picture is larger than the limits.
    #[error("frame {frame} of scene {key} cannot be decoded: {what}")]
    BadImage {
        /// Key of the scene.
        key: String,
        /// Position of the frame in the scene.
        frame: usize,
        /// The decoder's reason.
        what: String,
    },
    /// A picture cannot be written.
    #[error("encoding a {width}x{height} picture failed: {what}")]
    Encode {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// The encoder's reason.
        what: String,
    },
    /// A picture is asked for at a larger size than its file has.
    #[error(
        "cannot make a {width}x{height} picture from one of {from_width}x{from_height}: upscaling is not supported, lower the configured size"
    )]
    Upscale {
        /// Columns asked for.
        width: usize,
        /// Rows asked for.
        height: usize,
        /// Columns of the file's picture.
        from_width: usize,
        /// Rows of the file's picture.
        from_height: usize,
    },
    /// The camera centres that set a scene's scale coincide, so that there is no scale.
    #[error(
        "scene {key} has no baseline: its {num_views} camera centres lie within {extent:.3e} of their mean, \
         less than {threshold:.3e}, what f32 files can resolve there; leave the scene out or choose other frames"
    )]
    ZeroBaseline {
        /// Key of the scene.
        key: String,
        /// How many views set the scale.
        num_views: usize,
        /// Largest distance along an axis from the mean centre, in world units.
        extent: f64,
        /// Smallest extent that is accepted, in world units.
        threshold: f64,
    },
    /// A frame of a scene cannot be used.
    #[error("frame {frame} of scene {key}: {source}")]
    InFrame {
        /// Key of the scene.
        key: String,
        /// Position of the frame in the scene.
        frame: usize,
        /// What is wrong with it.
        source: Box<DataError>,
    },
    /// A configuration value cannot be used.
    #[error("{key} {problem}")]
    BadConfig {
        /// Dotted key of the value, relative to its table.
        key: String,
        /// The value, what is wrong with it and what would be right, as a verb phrase.
        problem: String,
    },
    /// A scene is too short for the views that are to be drawn from it.
    #[error("not enough frames: {needed} needed, {got} in the scene")]
    NotEnoughFrames {
        /// Fewest frames that would do.
        needed: usize,
        /// Frames the scene has.
        got: usize,
    },
    /// A scene was asked for that the source does not have.
    #[error("there are {num_scenes} scenes, so there is no scene {scene} (counted from 0)")]
    NoSuchScene {
        /// Position asked for.
        scene: usize,
        /// How many scenes the source has.
        num_scenes: usize,
    },
    /// No scene is left to train or evaluate on.
    #[error("no usable scene: {reason}")]
    NoScenes {
        /// Split, and why its scenes were skipped.
        reason: String,
    },
    /// A batch slot found no usable scene within its tries.
    #[error(
        "no usable scene for slot {slot} of step {step} in {attempts} tries; the last, {key}, failed with: {reason}"
    )]
    NoUsableScene {
        /// Step of the batch.
        step: u64,
        /// Slot of the batch.
        slot: usize,
        /// How many scenes were tried.
        attempts: u32,
        /// Key of the last scene tried.
        key: String,
        /// Why the last one failed.
        reason: String,
    },
    /// The code that makes a batch panicked.
    #[error(transparent)]
    WorkerPanic(#[from] WorkerPanic),
}

/// The code that makes a batch panicked; the other batches are unaffected.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("making the batch of step {step} panicked: {message}")]
pub struct WorkerPanic {
    /// Step of the batch.
    pub step: u64,
    /// Message of the panic.
    pub message: String,
}

impl DataError {
    /// A [`DataError::BadConfig`] about `key`.
    pub fn bad_config(key: impl Into<String>, problem: impl Into<String>) -> Self {
        Self::BadConfig { key: key.into(), problem: problem.into() }
    }

    /// Wraps an operating-system error; for `map_err`.
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        move |source| Self::Io { action, source, path: path.to_path_buf() }
    }
}
