//! What the readers give and the model takes: frames, views, clips.

use crate::camera::{Camera, Intrinsics};
use crate::error::DataError;
use crate::pose::Pose;
pub use crate::rgb_image::Frame;

/// Which frames of a scene are given and which are to be rendered: list positions, not time stamps.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ViewIndices {
    /// Frames the encoder sees.
    pub context: Vec<usize>,
    /// Frames to render.
    pub target: Vec<usize>,
}

/// Posed views of one scene at the model's resolution, in the scene's normalised frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Views {
    /// Columns of every view.
    pub width: usize,
    /// Rows of every view.
    pub height: usize,
    /// `[num_views, height, width, 3]`, 8-bit RGB.
    pub images: Vec<u8>,
    /// Normalised camera-to-world poses, one per view.
    pub c2w: Vec<Pose>,
    /// Intrinsics in pixels, one per view.
    pub intrinsics: Vec<Intrinsics>,
    /// Frame of the scene each view is.
    pub frame_index: Vec<usize>,
}

impl Views {
    /// How many views there are.
    pub fn num_views(&self) -> usize {
        self.c2w.len()
    }
}

/// One training or evaluation item: context and target views of one scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Clip {
    /// Key of the scene.
    pub key: String,
    /// Given views.
    pub context: Views,
    /// Views to render, with their ground truth.
    pub target: Views,
}

/// Scenes with random access to single frames: chunks or photos on disk, or synthetic ones made on the fly.
pub trait SceneSource: Send + Sync {
    /// How many scenes there are.
    fn num_scenes(&self) -> usize;
    /// Key of scene `scene` in `0..num_scenes()`.
    fn key(&self, scene: usize) -> &str;
    /// Position of a key, if the source has it.
    fn find(&self, key: &str) -> Option<usize>;
    /// Cameras of every frame of a scene, in frame order.
    fn cameras(&self, scene: usize) -> Result<Vec<Camera>, DataError>;
    /// How many frames a scene has; unless a source knows better, by reading its cameras.
    fn num_frames(&self, scene: usize) -> Result<usize, DataError> {
        Ok(self.cameras(scene)?.len())
    }
    /// Time stamp of every frame: microseconds in RealEstate10K, otherwise frame numbers; by default positions.
    fn timestamps(&self, scene: usize) -> Result<Vec<i64>, DataError> {
        Ok((0..self.num_frames(scene)? as i64).collect())
    }
    /// Where a scene comes from; empty if nothing says.
    fn url(&self, _scene: usize) -> Result<String, DataError> {
        Ok(String::new())
    }
    /// Decodes one frame.
    fn frame(&self, scene: usize, frame: usize) -> Result<Frame, DataError>;
    /// The JPEG or PNG file that [`SceneSource::frame`] decodes, byte by byte; `None` where there is none: the picture
    /// is computed, or resampled on load.
    fn encoded_frame(&self, _scene: usize, _frame: usize) -> Result<Option<Vec<u8>>, DataError> {
        Ok(None)
    }
}
