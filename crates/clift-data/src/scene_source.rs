//! The interface of every data source, and the two splits of a data set.

use serde::{Deserialize, Serialize};
use strum::Display;

use crate::error::DataError;
use crate::geometry::camera::Camera;
use crate::image::rgb_image::RgbImage;

/// One of the two splits of a data set. Prints as `train` or `test`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, Display)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case")]
pub enum Split {
    /// Scenes to train on.
    #[default]
    Train,
    /// Scenes held back for testing.
    Test,
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
    fn frame(&self, scene: usize, frame: usize) -> Result<RgbImage, DataError>;
    /// The JPEG or PNG file that [`SceneSource::frame`] decodes, byte by byte; `None` where there is none: the picture
    /// is computed, or resampled on load.
    fn encoded_frame(&self, _scene: usize, _frame: usize) -> Result<Option<Vec<u8>>, DataError> {
        Ok(None)
    }
}
