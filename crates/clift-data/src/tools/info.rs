//! Summary of a source: counts, image size, fields of view, extents.

use std::collections::BTreeMap;

use clift_core::{Camera, DVec3, IntrinsicsNorm, MinMedianMax};
use rayon::prelude::*;
use serde::Serialize;

use crate::error::DataError;
use crate::scene_source::SceneSource;
use crate::skip_report::SkippedScene;

/// Largest number of scenes whose image size is read.
const MAX_SIZED_SCENES: usize = 1000;

/// Summary of a source. The optional fields are `None` for a source without scenes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SourceInfo {
    /// Number of scenes.
    pub num_scenes: usize,
    /// Frames per scene.
    pub num_frames: Option<MinMedianMax>,
    /// Number of scenes by the size of their first frame, `WIDTHxHEIGHT`. Of more than 1,000 scenes, 1,000 evenly
    /// spread ones count.
    pub image_sizes: BTreeMap<String, usize>,
    /// Wider field of view of each frame, in degrees.
    pub fov_deg: Option<MinMedianMax>,
    /// Largest distance of a camera centre from the mean centre along a world axis, one number per scene.
    pub extent: Option<MinMedianMax>,
    /// Scenes with unreadable cameras or an unreadable first image; the reason is the error.
    pub unreadable: Vec<SkippedScene>,
}

impl SourceInfo {
    /// Reads the cameras of every scene and the size of a frame, on all cores.
    pub fn read(source: &dyn SceneSource) -> Result<Self, DataError> {
        let every = source.num_scenes().div_ceil(MAX_SIZED_SCENES).max(1);
        let read = (0..source.num_scenes()).into_par_iter().map(|scene| {
            let cameras = source.cameras(scene)?;
            let fov_deg: Vec<f64> = cameras.iter().map(Camera::fov_deg).map(|(x, y)| x.max(y)).collect();
            let is_sized = scene % every == 0 && !cameras.is_empty();
            let size = is_sized.then(|| source.image_size(scene, 0)).transpose();
            Ok((cameras.len(), fov_deg, extent(&cameras), size))
        });
        let read: Vec<Result<_, DataError>> = read.collect();
        let (mut scenes, mut unreadable, mut first_error) = (Vec::new(), Vec::new(), None);
        let mut image_sizes = BTreeMap::new();
        for (scene, found) in read.into_iter().enumerate() {
            let mut fail = |error: DataError| {
                unreadable.push(SkippedScene { key: source.key(scene).to_owned(), reason: error.to_string() });
                first_error.get_or_insert(error);
            };
            match found {
                Ok((num_frames, fov_deg, extent, size)) => {
                    if let Some([width, height]) = size.unwrap_or_else(|error| {
                        fail(error);
                        None
                    }) {
                        *image_sizes.entry(format!("{width}x{height}")).or_insert(0) += 1;
                    }
                    scenes.push((num_frames, fov_deg, extent));
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
            image_sizes,
            fov_deg: MinMedianMax::of(&fields),
            extent: MinMedianMax::of(&extents),
            unreadable,
        })
    }
}

/// Returns the largest distance of a camera centre from the mean centre along a world axis.
fn extent(cameras: &[Camera<IntrinsicsNorm>]) -> f64 {
    let count = cameras.len() as f64;
    let mean: DVec3 = cameras.iter().map(|camera| camera.c2w.translation / count).sum();
    cameras.iter().map(|camera| (camera.c2w.translation - mean).abs().max_element()).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_source::Split;
    use crate::sources::chunks::chunk_source::ChunkSource;
    use crate::sources::filters::SceneFilters;
    use crate::testing::{fixture, re10k_mini};

    fn sizes(num_scenes: usize) -> BTreeMap<String, usize> {
        BTreeMap::from([("64x36".into(), num_scenes)])
    }

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
        assert_eq!((&info.image_sizes, info.num_frames.map(|frames| frames.max)), (&sizes(1), Some(8.0)));
        assert_eq!((info.unreadable.len(), info.unreadable[0].key.as_str()), (1, "elsewhere"));
        assert!(info.unreadable[0].reason.contains("expected scene elsewhere"), "{info:?}");
    }

    #[test]
    fn summary_of_the_fixture_matches_values_by_hand() {
        let info = SourceInfo::read(&re10k_mini(Split::Train)).unwrap();
        assert_eq!((info.num_scenes, info.image_sizes), (2, sizes(2)));
        assert_eq!(info.num_frames, Some(MinMedianMax { min: 8.0, median: 8.0, max: 8.0 }));
        // 2 atan(0.5 / 0.9) = 58.1 degrees; centres are 0, 0.1, .., 0.7 along x, up to 0.35 from the mean.
        assert_eq!(format!("{:.1}", info.fov_deg.unwrap()), "58.1 / 58.1 / 58.1");
        assert_eq!(format!("{:.3}", info.extent.unwrap()), "0.350 / 0.350 / 0.350");
    }
}
