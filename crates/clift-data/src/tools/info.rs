//! A short description of a source, for people: counts, sizes, fields of view, extents.

use rayon::prelude::*;
use serde::Serialize;

use crate::error::DataError;
use crate::geometry::camera::Camera;
use crate::scene_source::SceneSource;
use crate::skip_report::SkippedScene;
use crate::statistics::MinMedianMax;

/// What a source holds. Spreads and sizes are `None` for a source without scenes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SourceInfo {
    /// How many scenes there are.
    pub num_scenes: usize,
    /// Frames per scene.
    pub num_frames: Option<MinMedianMax>,
    /// Columns and rows of the first frame there is.
    pub image_size: Option<[usize; 2]>,
    /// The wider of the two fields of view, one number per frame.
    pub fov_deg: Option<MinMedianMax>,
    /// Largest distance along a world axis of a camera centre from the scene's mean centre, one number per scene.
    pub extent: Option<MinMedianMax>,
    /// Scenes whose cameras cannot be read, and those before the first whose first image can, with the error as the
    /// reason.
    pub unreadable: Vec<SkippedScene>,
}

impl SourceInfo {
    /// Reads every scene's cameras, on all cores, and one frame.
    ///
    /// # Errors
    /// The first scene's when none can be read.
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
    use std::path::Path;

    use super::*;
    use crate::scene_source::Split;
    use crate::sources::chunks::chunk_source::ChunkSource;
    use crate::sources::filters::SceneFilters;

    #[test]
    fn a_scene_that_cannot_be_read_is_named_and_the_others_are_described() {
        let root = tempfile::tempdir().unwrap();
        let train = root.path().join("train");
        std::fs::create_dir(&train).unwrap();
        let mini = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../data-fixtures/re10k-mini/train");
        std::fs::copy(mini.join("000000.torch"), train.join("000000.torch")).unwrap();
        let index = r#"{"00000000000000a1": "000000.torch", "elsewhere": "000000.torch"}"#;
        std::fs::write(train.join("index.json"), index).unwrap();
        let source = ChunkSource::open(root.path(), Split::Train, &SceneFilters::default()).unwrap();
        let info = SourceInfo::read(&source).unwrap();
        assert_eq!((info.image_size, info.num_frames.map(|frames| frames.max)), (Some([64, 36]), Some(8.0)));
        assert_eq!((info.unreadable.len(), info.unreadable[0].key.as_str()), (1, "elsewhere"));
        assert!(info.unreadable[0].reason.contains("expected scene elsewhere"), "{info:?}");
    }

    #[test]
    fn a_source_is_described_by_counts_size_field_of_view_and_extent() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../data-fixtures/re10k-mini");
        let source = ChunkSource::open(&root, Split::Train, &SceneFilters::default()).unwrap();
        let info = SourceInfo::read(&source).unwrap();
        assert_eq!((info.num_scenes, info.image_size), (2, Some([64, 36])));
        assert_eq!(info.num_frames, Some(MinMedianMax { min: 8.0, median: 8.0, max: 8.0 }));
        // 2 atan(0.5 / 0.9) = 58.1 degrees; centres are 0, 0.1, .., 0.7 along x, 0.35 from their mean.
        assert_eq!(format!("{:.1}", info.fov_deg.unwrap()), "58.1 / 58.1 / 58.1");
        assert_eq!(format!("{:.3}", info.extent.unwrap()), "0.350 / 0.350 / 0.350");
    }
}
