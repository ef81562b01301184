//! Summary of a source: counts, image size, fields of view, extents.

use rayon::prelude::*;
use serde::Serialize;

use crate::error::DataError;
use crate::geometry::camera::Camera;
use crate::scene_source::SceneSource;
use crate::skip_report::SkippedScene;
use crate::statistics::MinMedianMax;

/// Summary of a source. The optional fields are `None` for a source without scenes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SourceInfo {
    /// Number of scenes.
    pub num_scenes: usize,
    /// Frames per scene.
    pub num_frames: Option<MinMedianMax>,
    /// Columns and rows of the first readable frame.
    pub image_size: Option<[usize; 2]>,
    /// Wider field of view of each frame, in degrees.
    pub fov_deg: Option<MinMedianMax>,
    /// Largest distance of a camera centre from the mean centre along a world axis, one number per scene.
    pub extent: Option<MinMedianMax>,
    /// Scenes with unreadable cameras, and scenes with an unreadable first image until one is readable; the reason is
    /// the error.
    pub unreadable: Vec<SkippedScene>,
}

impl SourceInfo {
    /// Reads the cameras of every scene, on all cores, and one frame.
    ///
    /// # Errors
    /// The error of the first scene if no scene can be read.
    pub fn read(source: &dyn SceneSource) -> Result<Self, DataError> {
        let read = (0..source.num_scenes()).into_par_iter().map(|scene| {
            let cameras = source.cameras(scene)?;
            let fov_deg: Vec<f64> = cameras.iter().map(Camera::fov_deg).map(|(x, y)| x.max(y)).collect();
            Ok((cameras.len(), fov_deg, extent(&cameras)))
        });
        let read: Vec<Result<_, DataError>> = read.collect();
        let (mut scenes, mut unreadable, mut first_error, mut first_image) = (Vec::new(), Vec::new(), None, None);
        for (scene, found) in read.into_iter().enumerate() {
            let mut fail = |error: DataError| {
                unreadable.push(SkippedScene { key: source.key(scene).to_owned(), reason: error.to_string() });
                first_error.get_or_insert(error);
            };
            match found {
                Ok(found) => {
                    if first_image.is_none() && found.0 > 0 {
                        first_image = source.frame(scene, 0).map_err(&mut fail).ok();
                    }
                    scenes.push(found);
                }
                Err(error) => fail(error),
            }
        }
        if let (true, Some(error)) = (scenes.is_empty(), first_error) {
            return Err(error);
        }
        let lengths: Vec<f64> = scenes.iter().map(|(num_frames, ..)| *num_frames as f64).collect();
        let fields: Vec<f64> = scenes.iter().flat_map(|(_, fov_deg, _)| fov_deg).copied().collect();
        let extents: Vec<f64> = scenes.iter().map(|(.., extent)| *extent).collect();
        Ok(Self {
            num_scenes: source.num_scenes(),
            num_frames: MinMedianMax::of(&lengths),
            image_size: first_image.map(|frame| [frame.width, frame.height]),
            fov_deg: MinMedianMax::of(&fields),
            extent: MinMedianMax::of(&extents),
            unreadable,
        })
    }
}

/// Returns the largest distance of a camera centre from the mean centre along a world axis.
fn extent(cameras: &[Camera]) -> f64 {
    let count = cameras.len() as f64;
    let axis = |i: usize| {
        let mean: f64 = cameras.iter().map(|camera| camera.c2w.translation[i] / count).sum();
        cameras.iter().map(|camera| (camera.c2w.translation[i] - mean).abs()).fold(0.0, f64::max)
    };
    axis(0).max(axis(1)).max(axis(2))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_source::Split;
    use crate::sources::chunks::chunk_source::ChunkSource;
    use crate::sources::filters::SceneFilters;
    use crate::testing::{fixture, re10k_mini};

    #[test]
    fn unreadable_scene_is_named_and_the_others_are_summarised() {
        let root = tempfile::tempdir().unwrap();
        let train = root.path().join("train");
        std::fs::create_dir(&train).unwrap();
        std::fs::copy(fixture("re10k-mini/train/000000.torch"), train.join("000000.torch")).unwrap();
        let index = r#"{"00000000000000a1": "000000.torch", "elsewhere": "000000.torch"}"#;
        std::fs::write(train.join("index.json"), index).unwrap();
        let source = ChunkSource::open(root.path(), Split::Train, &SceneFilters::default()).unwrap();
        let info = SourceInfo::read(&source).unwrap();
        assert_eq!((info.image_size, info.num_frames.map(|frames| frames.max)), (Some([64, 36]), Some(8.0)));
        assert_eq!((info.unreadable.len(), info.unreadable[0].key.as_str()), (1, "elsewhere"));
        assert!(info.unreadable[0].reason.contains("expected scene elsewhere"), "{info:?}");
    }

    #[test]
    fn summary_of_the_fixture_matches_values_by_hand() {
        let info = SourceInfo::read(&re10k_mini(Split::Train)).unwrap();
        assert_eq!((info.num_scenes, info.image_size), (2, Some([64, 36])));
        assert_eq!(info.num_frames, Some(MinMedianMax { min: 8.0, median: 8.0, max: 8.0 }));
        // 2 atan(0.5 / 0.9) = 58.1 degrees; centres are 0, 0.1, .., 0.7 along x, up to 0.35 from the mean.
        assert_eq!(format!("{:.1}", info.fov_deg.unwrap()), "58.1 / 58.1 / 58.1");
        assert_eq!(format!("{:.3}", info.extent.unwrap()), "0.350 / 0.350 / 0.350");
    }
}
