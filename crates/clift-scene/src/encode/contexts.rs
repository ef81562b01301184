//! The context views of a scene: requested frames, frames along the camera path, or groups of neighbours.
//!
//! A group is encoded as views were in training: views far apart, encoded together, come out as fog.

use std::collections::BTreeSet;

use clift_core::{Pose, PoseNormalization, ViewDistance};
use clift_data::{ClipReader, DataError, ViewSampler, contexts_along_path};
use clift_model::{Grouping, KMeans, ModelConfig, ModelError, TokenCount};

use crate::error::SceneError;
use crate::scene::scene::ContextGroup;

/// Most context views of a scene in groups.
const MAX_VIEWS: usize = 128;
/// Groups of neighbours over the context views, by default.
const GROUPS_PER_VIEW: f64 = 0.75;
/// Fewest stored tokens of a group, by default.
const MIN_TOKENS: usize = 32;

/// Settings of [`encode`](crate::encode).
#[derive(Clone, Debug, PartialEq)]
pub struct EncodeOptions {
    /// Context views and their groups.
    pub context: ContextChoice,
    /// One frame of this many is held out: it is not a context view. 0 for none.
    pub hold_out: usize,
    /// Number of stored tokens of all groups; `None` for a quarter of one group, a half of several (of many down to an
    /// eighth), or for all tokens of a network without clusters.
    pub stored_tokens: Option<TokenCount>,
    /// Token groups that the model was trained on.
    pub grouping: Grouping,
    /// Latent K-means.
    pub kmeans: KMeans,
    /// Seed of the run.
    pub seed: u64,
    /// Path of the model for the scene file, see [`Scene::model_path_for`](crate::Scene::model_path_for).
    pub model_path: String,
}

impl Default for EncodeOptions {
    /// The options for the default config of a run.
    fn default() -> Self {
        Self {
            context: ContextChoice::Spread(ViewSampler::default().max_context),
            hold_out: 0,
            stored_tokens: None,
            grouping: Grouping::default(),
            kmeans: KMeans::default(),
            seed: 0,
            model_path: String::new(),
        }
    }
}

/// The context views of a scene, and which of them are encoded together.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ContextChoice {
    /// These frames, encoded together.
    Frames(Vec<usize>),
    /// A number of frames at equal distances along the camera path, or all frames of a shorter path, encoded together.
    Spread(usize),
    /// A frame and those nearest to it, encoded together.
    Near {
        /// The frame.
        frame: usize,
        /// Number of views with the frame.
        num_views: usize,
    },
    /// All frames, or 128 along a longer path, in overlapping groups of neighbours: three for every four views, and more if
    /// these leave a view out; fewer, which leave views out, if a number of stored tokens is less than 32 a group.
    Neighbours {
        /// Views of a group.
        num_views: usize,
    },
}

impl ContextChoice {
    /// Returns the choice for a captured scene and a network that was trained with up to `num_views` views: groups of
    /// neighbours; of learned tokens, which have no place, views along the path.
    pub fn for_capture(model: &ModelConfig, num_views: usize) -> Self {
        if model.has_patch_tokens() { Self::Neighbours { num_views } } else { Self::Spread(num_views) }
    }
}

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
        let ContextChoice::Neighbours { num_views } = options.context else {
            let normalization = find(&of_frames(&frames))?;
            return Ok(Self { groups: vec![ContextGroup::of_all(frames.len())], frames, normalization });
        };
        let few = most_groups(options.stored_tokens, frames.len());
        let count = few.unwrap_or(default_groups(frames.len()));
        let groups = neighbour_groups(&of_frames(&frames), num_views, count, few.is_none());
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
        Ok(Self { groups: groups.collect(), frames, normalization })
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
            let fix = format!("the scene has {num_frames} frames; list the frames to use");
            bad("--context", num_views.to_string(), fix)
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
        ContextChoice::Neighbours { .. } => spread(MAX_VIEWS)?,
    };
    Ok(positions.into_iter().map(|position| kept[position]).collect())
}

fn bad(key: &'static str, value: String, fix: String) -> SceneError {
    ModelError::BadConfig { key, value, fix }.into()
}

/// Chooses `num_groups` groups of `num_views` neighbours, in ascending order each. Groups overlap. If `all` views must be
/// members, there are more than `num_groups` where these leave a view out.
///
/// A group is a seed with the views nearest to it. The next seed is the view farthest from all seeds, among the views in no
/// group as long as there are any.
pub(crate) fn neighbour_groups(views: &[Pose], num_views: usize, num_groups: usize, all: bool) -> Vec<Vec<usize>> {
    let distance = ViewDistance::new(views);
    let mut to_seeds = vec![f64::INFINITY; views.len()];
    let mut is_left_out = vec![true; views.len()];
    let mut groups = Vec::new();
    for _ in 0..views.len() {
        let any_left = is_left_out.contains(&true);
        if groups.len() >= num_groups && !(all && any_left) {
            break;
        }
        // The first of equally far views.
        let candidates = (0..views.len()).rev().filter(|&view| is_left_out[view] || !any_left);
        let Some(seed) = candidates.max_by(|&a, &b| to_seeds[a].total_cmp(&to_seeds[b])) else { break };
        let group = distance.nearest(views, seed, num_views);
        for &view in &group {
            is_left_out[view] = false;
        }
        for (view, least) in to_seeds.iter_mut().enumerate() {
            *least = least.min(distance.between(&views[view], &views[seed]));
        }
        groups.push(group);
    }
    groups.sort();
    groups.dedup();
    groups
}

#[cfg(test)]
mod tests {
    use clift_core::DVec3;

    use super::*;

    fn on_a_line(places: &[f64]) -> Vec<Pose> {
        places.iter().map(|&x| Pose { translation: x * DVec3::X, ..Pose::IDENTITY }).collect()
    }

    #[test]
    fn groups_are_neighbours_and_contain_every_view() {
        let steady: Vec<f64> = (0..10).map(f64::from).collect();
        let groups = |places: &[f64], count| neighbour_groups(&on_a_line(places), 4, count, true);
        assert_eq!(groups(&steady, 1), [vec![0, 1, 2, 3], vec![2, 3, 4, 5], vec![6, 7, 8, 9]], "as few as needed");
        let more = groups(&steady, 6);
        assert!(more.iter().all(|group| group.len() == 4 && group[3] - group[0] <= 4), "{more:?}");
        assert_eq!(groups(&steady[..3], 5), [vec![0, 1, 2]], "equal groups count once");
        assert_eq!(neighbour_groups(&on_a_line(&steady), 4, 1, false), [[0, 1, 2, 3]], "others are left out");
        // Two clusters far apart are not mixed.
        let apart = groups(&[0.0, 0.1, 0.2, 0.3, 9.0, 9.1, 9.2, 9.3], 2);
        assert_eq!(apart, [vec![0, 1, 2, 3], vec![4, 5, 6, 7]]);
        // Few tokens have few groups: 32 for each of 30.
        let most = |count| most_groups(Some(TokenCount::Count(count)), 40);
        assert_eq!([20, 100, 960].map(most), [Some(1), Some(3), None]);
    }

    #[test]
    fn context_frames_are_checked_spread_or_neighbours() {
        let poses = on_a_line(&[0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]);
        let frames = |choice: ContextChoice| choose_frames(&poses, &choice, &[]).map_err(|error| error.to_string());
        assert_eq!(frames(ContextChoice::Spread(4)).unwrap(), [0, 3, 6, 9]);
        assert_eq!(choose_frames(&poses[..3], &ContextChoice::Spread(4), &[]).unwrap(), [0, 1, 2]);
        assert_eq!(frames(ContextChoice::Frames(vec![7, 2])).unwrap(), [7, 2]);
        assert_eq!(frames(ContextChoice::Near { frame: 8, num_views: 3 }).unwrap(), [7, 8, 9]);
        assert_eq!(choose_frames(&poses, &ContextChoice::Spread(9), &[0, 4, 8]).unwrap(), [1, 2, 3, 5, 6, 7, 9]);
        let near = frames(ContextChoice::Near { frame: 12, num_views: 3 }).unwrap_err();
        assert_eq!(near, "`--near` = 12: there is no frame 12; the scene has frames 0 to 9");
        for (list, expected) in [
            (vec![0, 10], "`--context` = 0,10: there is no frame 10; the scene has frames 0 to 9"),
            (vec![3, 3], "`--context` = 3,3: write at least two frames, each once"),
            (vec![3], "`--context` = 3: write at least two frames, each once"),
        ] {
            assert_eq!(frames(ContextChoice::Frames(list)).unwrap_err(), expected);
        }
    }
}
