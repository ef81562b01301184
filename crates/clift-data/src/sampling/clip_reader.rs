//! Reads frames of a scene as a clip at the model's size, with normalised poses.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use clift_core::{Camera, ClipViews, IntrinsicsNorm, PoseNormalization, PoseRotation, PoseScale, RgbImage, check_near};
use rayon::prelude::*;

use crate::error::DataError;
use crate::image::fit::fit_image;
use crate::sampling::clip::{Clip, ViewIndices, at_half_resolution};
use crate::scene_source::SceneSource;

/// Options for the preparation of frames and poses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClipOptions {
    /// Columns of every view, before `half_size`.
    pub width: usize,
    /// Rows of every view, before `half_size`.
    pub height: usize,
    /// Computation of the mean orientation of the contexts.
    pub pose_rotation: PoseRotation,
    /// Cameras that determine the scale.
    pub pose_scale: PoseScale,
    /// Whether the fitted views are reduced to half as many columns and rows ([`Clip::at_half_resolution`]).
    pub half_size: bool,
}

/// The paper's 256 x 256 pixels.
impl Default for ClipOptions {
    fn default() -> Self {
        Self {
            width: 256,
            height: 256,
            pose_rotation: PoseRotation::default(),
            pose_scale: PoseScale::default(),
            half_size: false,
        }
    }
}

/// Reads clips from a source.
#[derive(Clone)]
pub struct ClipReader {
    /// Source of the scenes.
    pub source: Arc<dyn SceneSource>,
    /// Preparation of the views.
    pub options: ClipOptions,
}

impl ClipReader {
    /// Reads each distinct frame of `views` once, fits the frames to the configured size, normalises the poses by the
    /// contexts, and reduces the views with `half_size`.
    ///
    /// # Errors
    /// [`DataError::NoSuchFrame`] for a position beyond the scene, [`DataError::InFrame`] around
    /// [`DataError::Camera`] for a camera too far from the contexts, and the errors of reading cameras and frames, of
    /// fitting ([`DataError::Upscale`]) and of normalising ([`DataError::Camera`]).
    pub fn read(&self, scene: usize, views: &ViewIndices) -> Result<Clip, DataError> {
        let key = self.source.key(scene);
        let frames = [&views.context[..], &views.target].concat();
        let cameras = self.cameras(scene, &frames)?;
        let poses = |frames: &[usize]| frames.iter().map(|frame| cameras[*frame].c2w).collect::<Vec<_>>();
        let (context, target) = (poses(&views.context), poses(&views.target));
        let ClipOptions { pose_rotation, pose_scale, .. } = self.options;
        let normalization = PoseNormalization::find(key, &context, &target, pose_rotation, pose_scale)?;
        let fitted = self.fit_frames(scene, &frames, &cameras, &normalization)?;
        let num_pixels = self.options.width * self.options.height;
        let weights = |frame: &usize| fitted[frame].weights.clone().unwrap_or_else(|| vec![u8::MAX; num_pixels]);
        let has_weights = views.target.iter().any(|frame| fitted[frame].weights.is_some());
        let clip = Clip {
            key: key.to_owned(),
            context: self.gather(&views.context, &fitted),
            target: self.gather(&views.target, &fitted),
            target_weights: has_weights.then(|| views.target.iter().flat_map(weights).collect()),
        };
        Ok(if self.options.half_size { clip.at_half_resolution() } else { clip })
    }

    /// Reads frames as [`read`](Self::read) does, with the poses of a normalization that is known already.
    ///
    /// # Errors
    /// As [`read`](Self::read).
    pub fn read_views(
        &self,
        scene: usize,
        frames: &[usize],
        normalization: &PoseNormalization,
    ) -> Result<ClipViews, DataError> {
        let cameras = self.cameras(scene, frames)?;
        let views = self.gather(frames, &self.fit_frames(scene, frames, &cameras, normalization)?);
        Ok(if self.options.half_size { at_half_resolution(&views) } else { views })
    }

    /// Returns the cameras of a scene, after a check of those of `frames`.
    fn cameras(&self, scene: usize, frames: &[usize]) -> Result<Vec<Camera<IntrinsicsNorm>>, DataError> {
        let (key, cameras) = (self.source.key(scene), self.source.cameras(scene)?);
        for &frame in frames {
            let missing = || DataError::NoSuchFrame { key: key.to_owned(), frame, num_frames: cameras.len() };
            let camera = cameras.get(frame).ok_or_else(missing)?;
            camera.c2w.check_finite().map_err(DataError::in_frame(key, frame))?;
        }
        Ok(cameras)
    }

    /// Reads every distinct frame once, several at a time, after a check of all normalised poses.
    fn fit_frames(
        &self,
        scene: usize,
        frames: &[usize],
        cameras: &[Camera<IntrinsicsNorm>],
        normalization: &PoseNormalization,
    ) -> Result<HashMap<usize, FittedFrame>, DataError> {
        let (key, ClipOptions { width, height, .. }) = (self.source.key(scene), self.options);
        let c2w = |frame: usize| normalization.normalize(cameras[frame].c2w);
        for &frame in frames {
            check_near(&c2w(frame)).map_err(DataError::in_frame(key, frame))?;
        }
        let read = |&frame: &usize| {
            let fit = |image: &RgbImage| {
                fit_image(image, cameras[frame].intrinsics, width, height).map_err(DataError::in_frame(key, frame))
            };
            let (image, coverage) = self.source.frame_with_coverage(scene, frame)?;
            let weights = coverage.map(|coverage| fit(&coverage)).transpose()?;
            let weights = weights.map(|(coverage, _)| coverage.rgb.into_iter().step_by(3).collect());
            let (image, intrinsics) = fit(&image)?;
            Ok((frame, FittedFrame { image, camera: Camera { c2w: c2w(frame), intrinsics }, weights }))
        };
        let mut seen = HashSet::new();
        let distinct: Vec<usize> = frames.iter().copied().filter(|&frame| seen.insert(frame)).collect();
        let fitted: Vec<Result<_, _>> = distinct.par_iter().map(read).collect();
        // The error of the first frame, whichever was read first.
        fitted.into_iter().collect()
    }

    fn gather(&self, frames: &[usize], fitted: &HashMap<usize, FittedFrame>) -> ClipViews {
        ClipViews {
            width: self.options.width,
            height: self.options.height,
            images: frames.iter().flat_map(|frame| &fitted[frame].image.rgb).copied().collect(),
            cameras: frames.iter().map(|frame| fitted[frame].camera).collect(),
            frame_index: frames.to_vec(),
        }
    }
}

struct FittedFrame {
    image: RgbImage,
    camera: Camera,
    /// Weights of the pixels if some are left out.
    weights: Option<Vec<u8>>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_source::Split;
    use crate::testing::{TestSource, re10k_mini};
    use clift_core::Pose;
    use std::sync::atomic::{AtomicUsize, Ordering};

    fn options() -> ClipOptions {
        ClipOptions { width: 32, height: 32, ..ClipOptions::default() }
    }

    /// Returns a reader of the fixture's test scene with another pose of frame 4, and the count of decoded frames.
    fn reader(frame_4: Option<Pose>, options: ClipOptions) -> (ClipReader, Arc<AtomicUsize>) {
        let num_decoded = Arc::new(AtomicUsize::new(0));
        let counter = num_decoded.clone();
        let source = TestSource {
            base: Box::new(re10k_mini(Split::Test)),
            cameras: Box::new(move |base, scene| {
                let mut cameras = base.cameras(scene)?;
                cameras[4].c2w = frame_4.unwrap_or(cameras[4].c2w);
                Ok(cameras)
            }),
            frame: Box::new(move |base, scene, frame| {
                counter.fetch_add(1, Ordering::Relaxed);
                base.frame(scene, frame)
            }),
        };
        (ClipReader { source: Arc::new(source), options }, num_decoded)
    }

    fn views(context: &[usize], target: &[usize]) -> ViewIndices {
        ViewIndices { context: context.to_vec(), target: target.to_vec() }
    }

    #[test]
    fn views_keep_their_order_and_frames_are_decoded_once() {
        let (reader, num_decoded) = reader(None, options());
        let clip = reader.read(0, &views(&[7, 0, 2], &[2, 2, 5])).unwrap();
        assert_eq!(num_decoded.load(Ordering::Relaxed), 4);
        assert_eq!((clip.key.as_str(), clip.context.num_views()), ("00000000000000b1", 3));
        assert_eq!((&clip.context.frame_index[..], &clip.target.frame_index[..]), (&[7, 0, 2][..], &[2, 2, 5][..]));
        let bytes = 32 * 32 * 3;
        assert_eq!((clip.context.images.len(), clip.target.images.len()), (3 * bytes, 3 * bytes));
        assert_eq!(clip.context.images[2 * bytes..], clip.target.images[..bytes]);
        assert_eq!(clip.target.images[..bytes], clip.target.images[bytes..2 * bytes]);
        assert_ne!(clip.target.images[bytes..2 * bytes], clip.target.images[2 * bytes..]);
        assert_eq!(clip.context.cameras[2].c2w, clip.target.cameras[0].c2w);
        // 64x36 to 57x32, cropped to 32: fx = 0.9 * 57, fy = 1.6 * 32, as f32 files hold them.
        let intrinsics = clip.target.cameras[0].intrinsics;
        assert!((intrinsics.fx - 51.3).abs() < 1e-5 && (intrinsics.fy - 51.2).abs() < 1e-5, "{intrinsics:?}");
        assert_eq!((intrinsics.cx, intrinsics.cy), (16.0, 16.0));
    }

    #[test]
    fn non_finite_pose_names_scene_and_frame() {
        let broken = Pose { translation: [0.0, f64::NAN, 0.0].into(), ..Pose::IDENTITY };
        let (reader, _) = reader(Some(broken), options());
        let message = reader.read(0, &views(&[0, 7], &[3, 4])).unwrap_err().to_string();
        assert_eq!(message, "frame 4 of scene 00000000000000b1: bad camera: the pose holds NaN");
        assert!(reader.read(0, &views(&[0, 7], &[3])).is_ok());
    }

    #[test]
    fn equal_centres_missing_frames_and_upscaling_are_errors() {
        let message = |context: &[usize], width: usize| {
            let (reader, _) = reader(None, ClipOptions { width, ..options() });
            reader.read(0, &views(context, &[1])).unwrap_err().to_string()
        };
        let pan = message(&[2, 2], 32);
        assert!(pan.starts_with("scene 00000000000000b1 has no baseline") && pan.contains("the method needs parallax"));
        let missing = "scene 00000000000000b1 has 8 frames; frame 8 (counted from 0) does not exist";
        assert_eq!(message(&[0, 8], 32), missing);
        assert!(message(&[0, 7], 65).contains("cannot make a 65x32 image from a 64x36 image"));
    }
}
