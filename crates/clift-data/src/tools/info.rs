//! Summary of a source: counts, image size, fields of view, extents.

use std::collections::BTreeMap;

use clift_core::{Camera, DVec3, IntrinsicsNorm, MinMedianMax};
use rayon::prelude::*;
use serde::Serialize;

use crate::error::DataError;
use crate::scene_source::SceneSource;
use crate::skip_report::SkippedScene;

const MAX_SIZED_SCENES: usize = 1000;

/// Summary of a source. The optional fields are `None` for a source without readable scenes.
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
    pub fn read(source: &dyn SceneSource) -> Self {
        let num_scenes = source.num_scenes();
        let every = num_scenes.div_ceil(MAX_SIZED_SCENES).max(1);
        let read = |scene: usize| {
            let cameras = source.cameras(scene)?;
            let is_sized = scene.is_multiple_of(every) && !cameras.is_empty();
            let size = if is_sized { Some(source.image_size(scene, 0)?) } else { None };
            Ok((cameras, size))
        };
        let read: Vec<Result<_, DataError>> = (0..num_scenes).into_par_iter().map(read).collect();
        let (mut lengths, mut fields, mut extents) = (Vec::new(), Vec::new(), Vec::new());
        let (mut image_sizes, mut unreadable) = (BTreeMap::new(), Vec::new());
        for (scene, found) in read.into_iter().enumerate() {
            match found {
                Ok((cameras, size)) => {
                    lengths.push(cameras.len() as f64);
                    fields.extend(cameras.iter().map(Camera::fov_deg).map(|(x, y)| x.max(y)));
                    extents.push(extent(&cameras));
                    if let Some([width, height]) = size {
                        *image_sizes.entry(format!("{width}x{height}")).or_insert(0) += 1;
                    }
                }
                Err(error) => {
                    unreadable.push(SkippedScene { key: source.key(scene).to_owned(), reason: error.to_string() });
                }
            }
        }
        let [num_frames, fov_deg, extent] = [lengths, fields, extents].map(|values| MinMedianMax::of(&values));
        Self { num_scenes, num_frames, image_sizes, fov_deg, extent, unreadable }
    }
}

fn extent(cameras: &[Camera<IntrinsicsNorm>]) -> f64 {
    let count = cameras.len() as f64;
    let mean: DVec3 = cameras.iter().map(|camera| camera.c2w.translation / count).sum();
    cameras.iter().map(|camera| (camera.c2w.translation - mean).abs().max_element()).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::rooms_with_a_broken_one;

    #[test]
    fn unreadable_scene_is_named_and_the_others_are_summarised() {
        let source = rooms_with_a_broken_one(3);
        let info = SourceInfo::read(&source);
        assert_eq!((info.num_scenes, info.image_sizes), (3, BTreeMap::from([("32x32".into(), 2)])));
        assert_eq!(info.num_frames, Some(MinMedianMax { min: 8.0, median: 8.0, max: 8.0 }));
        let reason = "bad camera: the pose holds NaN".into();
        assert_eq!(info.unreadable, [SkippedScene { key: source.key(1).into(), reason }]);
    }
}
