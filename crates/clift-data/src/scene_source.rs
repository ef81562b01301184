//! The interface of every data source, and the two splits of a data set.

use clift_core::{Camera, IntrinsicsNorm, RgbImage};
use serde::{Deserialize, Serialize};
use strum::Display;

use crate::error::DataError;
use crate::image::jpeg_scan::check_image;

/// Returns whether a frame is held out of training: frames 0, `every`, 2 `every`, .., as in the practice of `NeRF`.
/// With 0 no frame is.
pub fn is_held_out(frame: usize, every: usize) -> bool {
    every > 0 && frame.is_multiple_of(every)
}

/// One of the two splits of a data set. Prints as `train` or `test`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, Display)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case")]
pub enum Split {
    /// Training scenes.
    #[default]
    Train,
    /// Test scenes.
    Test,
}

/// Scenes with random access to single frames: chunks or photos on disk, or synthetic rooms.
pub trait SceneSource: Send + Sync {
    /// Returns the number of scenes.
    fn num_scenes(&self) -> usize;
    /// Returns the key of scene `scene`, in `0..num_scenes()`.
    fn key(&self, scene: usize) -> &str;
    /// Returns the index of the scene with this key.
    fn find(&self, key: &str) -> Option<usize>;
    /// Returns the cameras of a scene, in frame order.
    fn cameras(&self, scene: usize) -> Result<Vec<Camera<IntrinsicsNorm>>, DataError>;
    /// Returns the number of frames of a scene. The default reads the cameras.
    fn num_frames(&self, scene: usize) -> Result<usize, DataError> {
        Ok(self.cameras(scene)?.len())
    }

    /// Returns the file name of every frame; empty for frames without files of their own.
    fn frame_names(&self, _scene: usize) -> Result<Vec<String>, DataError> {
        Ok(Vec::new())
    }

    /// Returns the frames of a scene that are held out of training, in order: the default returns every `every`-th one
    /// ([`is_held_out`]); captures that list the frames of their splits return the listed ones. With 0 no frame is held out.
    fn held_out(&self, scene: usize, every: usize) -> Result<Vec<usize>, DataError> {
        let num_frames = if every == 0 { 0 } else { self.num_frames(scene)? };
        Ok((0..num_frames).filter(|frame| is_held_out(*frame, every)).collect())
    }

    /// Returns columns and rows of a frame. The default decodes the frame.
    fn image_size(&self, scene: usize, frame: usize) -> Result<[usize; 2], DataError> {
        let image = self.frame(scene, frame)?;
        Ok([image.width, image.height])
    }

    /// Decodes one frame.
    fn frame(&self, scene: usize, frame: usize) -> Result<RgbImage, DataError>;
    /// Decodes one frame, and its coverage where a mask or an alpha channel leaves pixels out: an image of the same size
    /// whose three channels are 255 where a pixel counts and 0 where it does not. The pixels left out have the background
    /// colour. The default has no coverage.
    fn frame_with_coverage(&self, scene: usize, frame: usize) -> Result<(RgbImage, Option<RgbImage>), DataError> {
        Ok((self.frame(scene, frame)?, None))
    }

    /// Returns the bytes of the JPEG or PNG file of a frame; `None` for images that are computed, or resampled on load.
    fn encoded_frame(&self, _scene: usize, _frame: usize) -> Result<Option<Vec<u8>>, DataError> {
        Ok(None)
    }

    /// Checks the file of a frame, also for damage that decoders draw as a torn image. The default checks
    /// [`encoded_frame`](Self::encoded_frame).
    fn check_frame(&self, scene: usize, frame: usize) -> Result<(), DataError> {
        let bytes = self.encoded_frame(scene, frame)?;
        let bad = |what| DataError::BadImage { key: self.key(scene).to_owned(), frame, what };
        bytes.map_or(Ok(()), |bytes| check_image(&bytes).map_err(bad))
    }
}
