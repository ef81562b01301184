//! The context views of a scene: requested frames, frames along the camera path, or groups of neighbours.

use std::collections::BTreeSet;

use clift_core::{Pose, PoseNormalization, ViewDistance, median};
use clift_data::{ClipReader, DataError, contexts_along_path};
use clift_model::{ModelError, TokenCount};

use crate::encode::groups::{neighbour_groups, neighbour_partition};
use crate::encode::options::{ContextChoice, EncodeOptions};
use crate::error::SceneError;
use crate::scene::scene::ContextGroup;

/// Most context views of a scene in groups.
const MAX_VIEWS: usize = 128;
/// Groups of neighbours over the context views, by default.
const GROUPS_PER_VIEW: f64 = 0.75;
/// Fewest stored tokens of a group, by default.
const MIN_TOKENS: usize = 32;

/// The context views of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Contexts {
    /// Frames of the scene.
    pub frames: Vec<usize>,
    /// Groups of views that are encoded together.
    pub groups: Vec<ContextGroup>,
    /// The frame of their poses.
    pub normalization: PoseNormalization,
}

impl Contexts {
    /// Returns the context views that [`encode`](crate::encode) chooses.
    ///
    /// # Errors
    /// [`ModelError::BadConfig`] for frames that the scene does not have, those of the cameras, and
    /// [`CameraError::ZeroBaseline`](clift_core::CameraError::ZeroBaseline) for frames without a scale.
    pub fn choose(reader: &ClipReader, scene: usize, options: &EncodeOptions) -> Result<Self, SceneError> {
        let (key, data) = (reader.source.key(scene), &reader.options);
        let poses: Vec<Pose> = reader.source.cameras(scene)?.iter().map(|camera| camera.c2w).collect();
        let held_out = match options.hold_out {
            0 => Vec::new(),
            every => reader.source.held_out(scene, every)?,
        };
        let frames = choose_frames(&poses, &options.context, &held_out)?;
        let find = |views: &[Pose]| {
            PoseNormalization::find(key, views, &[], data.pose_rotation, data.pose_scale).map_err(DataError::from)
        };
        let of_frames = |frames: &[usize]| frames.iter().map(|&frame| poses[frame]).collect::<Vec<_>>();
        let ContextChoice::Neighbours { num_views, num_groups, joined } = options.context else {
            let normalization = find(&of_frames(&frames))?;
            return Ok(Self { groups: vec![ContextGroup::of_all(frames.len())], frames, normalization });
        };
        let groups = match num_groups.or(most_groups(options.stored_tokens, frames.len())) {
            _ if joined => neighbour_partition(&of_frames(&frames), num_views),
            Some(count) => neighbour_groups(&of_frames(&frames), num_views, count, false),
            None => neighbour_groups(&of_frames(&frames), num_views, default_groups(frames.len()), true),
        };
        // The members of the groups alone are context views.
        let members: BTreeSet<usize> = groups.iter().flatten().copied().collect();
        let position = |view: &usize| members.range(..view).count() as u32;
        let frames: Vec<usize> = members.iter().map(|&view| frames[view]).collect();
        let normalization = find(&of_frames(&frames))?;
        let context: Vec<Pose> = of_frames(&frames).into_iter().map(|pose| normalization.normalize(pose)).collect();
        let groups = groups.iter().map(|views| {
            let views: Vec<u32> = views.iter().map(position).collect();
            let poses: Vec<Pose> = views.iter().map(|&view| context[view as usize]).collect();
            // Views that turn in place, or look in opposite directions, have no frame of their own.
            let frame = find(&poses).unwrap_or(PoseNormalization { mean_c2w: poses[0], scale: 1.0 });
            ContextGroup { views, frame }
        });
        let contexts = Self { groups: groups.collect(), frames, normalization };
        Ok(if joined { contexts.with_shared_frame() } else { contexts })
    }

    /// Gives all groups one frame, whose scale is the median of theirs.
    fn with_shared_frame(mut self) -> Self {
        let scales: Vec<f64> = self.groups.iter().map(|group| group.frame.scale).collect();
        self.normalization.scale *= median(&scales);
        for group in &mut self.groups {
            group.frame = ContextGroup::of_all(0).frame;
        }
        self
    }

    /// Returns the number of members of all groups.
    pub fn num_members(&self) -> usize {
        self.groups.iter().map(|group| group.views.len()).sum()
    }
}

fn default_groups(num_frames: usize) -> usize {
    (GROUPS_PER_VIEW * num_frames as f64).ceil() as usize
}

/// Returns the most groups for which a number of stored tokens is enough; `None` if that is no limit.
fn most_groups(stored_tokens: Option<TokenCount>, num_frames: usize) -> Option<usize> {
    let Some(TokenCount::Count(count)) = stored_tokens else { return None };
    let most = (count / MIN_TOKENS).max(1);
    (most < default_groups(num_frames)).then_some(most)
}

/// Chooses frames of a scene that are not held out, or checks those of the choice.
fn choose_frames(poses: &[Pose], choice: &ContextChoice, held_out: &[usize]) -> Result<Vec<usize>, SceneError> {
    let num_frames = poses.len();
    let kept: Vec<usize> = (0..num_frames).filter(|frame| held_out.binary_search(frame).is_err()).collect();
    let kept_poses: Vec<Pose> = kept.iter().map(|&frame| poses[frame]).collect();
    let spread = |num_views: usize| {
        contexts_along_path(&kept_poses, num_views.min(kept.len())).ok_or_else(|| {
            bad(
                "--context",
                num_views.to_string(),
                format!("the scene has {num_frames} frames; list the frames to use"),
            )
        })
    };
    let no_frame =
        |frame| format!("there is no frame {frame}; the scene has frames 0 to {}", num_frames.saturating_sub(1));
    let positions = match *choice {
        ContextChoice::Frames(ref frames) => {
            let list = frames.iter().map(ToString::to_string).collect::<Vec<_>>().join(",");
            let mut sorted = frames.clone();
            sorted.sort_unstable();
            sorted.dedup();
            if frames.len() < 2 || sorted.len() < frames.len() {
                return Err(bad("--context", list, "write at least two frames, each once".into()));
            }
            return match frames.iter().find(|frame| **frame >= num_frames) {
                Some(&frame) => Err(bad("--context", list, no_frame(frame))),
                None => Ok(frames.clone()),
            };
        }
        ContextChoice::Near { frame, num_views } => {
            let Some(position) = kept.iter().position(|&other| other == frame) else {
                let fix = if frame < num_frames { "the frame is held out".into() } else { no_frame(frame) };
                return Err(bad("--near", frame.to_string(), fix));
            };
            ViewDistance::new(&kept_poses).nearest(&kept_poses, position, num_views)
        }
        ContextChoice::Spread(num_views) => spread(num_views)?,
        ContextChoice::Neighbours { num_views, num_groups: Some(count), joined: true } => {
            spread(MAX_VIEWS.min(num_views.saturating_mul(count)))?
        }
        ContextChoice::Neighbours { .. } => spread(MAX_VIEWS)?,
    };
    Ok(positions.into_iter().map(|position| kept[position]).collect())
}

fn bad(key: &'static str, value: String, fix: String) -> SceneError {
    ModelError::BadConfig { key, value, fix }.into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_with_a_shared_frame_have_the_median_scale() {
        let frame = |scale: f64| PoseNormalization { mean_c2w: Pose::IDENTITY, scale };
        let group = |scale: f64| ContextGroup { views: vec![0, 1], frame: frame(scale) };
        let groups = vec![group(4.0), group(3.0), group(9.0)];
        let contexts = Contexts { frames: vec![0, 1], groups, normalization: frame(0.5) }.with_shared_frame();
        assert_eq!(contexts.normalization, frame(2.0));
        assert!(contexts.groups.iter().all(|group| group.frame == frame(1.0)));
    }

    #[test]
    fn few_tokens_have_few_groups() {
        let most = |stored, num_frames| most_groups(stored, num_frames);
        assert_eq!(most(Some(TokenCount::Count(20)), 40), Some(1));
        assert_eq!(most(Some(TokenCount::Count(100)), 40), Some(3));
        assert_eq!(most(Some(TokenCount::Count(960)), 40), None, "32 for each of 30 groups");
        assert_eq!([most(Some(TokenCount::Share(0.001)), 40), most(None, 40)], [None; 2]);
    }

    #[test]
    fn context_frames_are_checked_spread_or_neighbours() {
        let at = |x: f64| Pose { translation: [x, 0.0, 0.0].into(), ..Pose::IDENTITY };
        let poses: Vec<Pose> = (0..10).map(f64::from).map(at).collect();
        let frames = |choice: ContextChoice| choose_frames(&poses, &choice, &[]).map_err(|error| error.to_string());
        assert_eq!(frames(ContextChoice::Spread(4)).unwrap(), [0, 3, 6, 9]);
        assert_eq!(choose_frames(&poses[..3], &ContextChoice::Spread(4), &[]).unwrap(), [0, 1, 2]);
        assert_eq!(frames(ContextChoice::Frames(vec![7, 2])).unwrap(), [7, 2]);
        assert_eq!(frames(ContextChoice::Near { frame: 8, num_views: 3 }).unwrap(), [7, 8, 9]);
        let all = ContextChoice::Neighbours { num_views: 4, num_groups: None, joined: false };
        assert_eq!(frames(all).unwrap(), (0..10).collect::<Vec<_>>());
        assert_eq!(choose_frames(&poses, &ContextChoice::Spread(9), &[0, 4, 8]).unwrap(), [1, 2, 3, 5, 6, 7, 9]);
        let near = frames(ContextChoice::Near { frame: 12, num_views: 3 }).unwrap_err();
        assert_eq!(near, "`--near` = 12: there is no frame 12; the scene has frames 0 to 9");
        let message = |list: &[usize]| frames(ContextChoice::Frames(list.to_vec())).unwrap_err();
        assert_eq!(message(&[0, 10]), "`--context` = 0,10: there is no frame 10; the scene has frames 0 to 9");
        assert_eq!(message(&[3, 3]), "`--context` = 3,3: write at least two frames, each once");
        assert_eq!(message(&[3]), "`--context` = 3: write at least two frames, each once");
    }
}
