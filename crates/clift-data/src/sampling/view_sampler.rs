//! Samples the context and target frames of a training item.

use clift_core::{
    BadConfig, Pose, ViewDistance, check_config, sample_distinct, sample_from, step_rng, uniform_below, uniform_between,
};
use rand::Rng;
use serde::{Deserialize, Serialize};

use crate::error::DataError;
use crate::sampling::clip::ViewIndices;
use crate::scene_source::SceneSource;

const MAX_VIEWS: usize = 10_000;

/// Returns the value at `step` of a linear warm-up from `init` to `last >= init`, truncated.
fn linear_warm_up(init: usize, last: usize, warm_up_steps: u64, step: u64) -> usize {
    if warm_up_steps == 0 || step >= warm_up_steps {
        return last;
    }
    init + (last.saturating_sub(init) as u128 * u128::from(step) / u128::from(warm_up_steps)) as usize
}

/// Frames that the views of an item are sampled from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Window {
    /// Consecutive frames, of a film or a clip.
    #[default]
    Consecutive,
    /// A frame and those nearest to it, by place and viewing direction: photos in any order.
    Nearest,
}

/// Samples a range of frames. The contexts are the two ends and some inner frames, the targets any frames of the range.
///
/// The gap (last minus first frame) is uniform in `[min_gap, max_gap]`, and both bounds grow during training
/// (linear warm-up). This is the `bounded_v2` sampler of DepthSplat, which the paper uses. The default is its
/// RealEstate10K setting with the paper's 4 to 6 contexts (paper, appendix).
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ViewSampler {
    /// Smallest number of context views of an item, at least 2.
    pub min_context: usize,
    /// Largest number of context views of an item. The number is sampled once per batch.
    pub max_context: usize,
    /// Smallest gap between the first and the last context frame, at step 0 and after the warm-up.
    pub min_gap: [usize; 2],
    /// Largest gap between the first and the last context frame, at step 0 and after the warm-up. Shorter scenes lower
    /// the gap, down to the smallest one.
    pub max_gap: [usize; 2],
    /// Steps of the warm-up of both gaps; 0 disables the warm-up.
    pub warm_up_steps: u64,
    /// Number of target views of an item. Targets may repeat, and may be context frames.
    pub num_targets: usize,
    /// The range: `consecutive` frames, or a frame and those `nearest` to it, as in photos without an order.
    pub window: Window,
}

impl Default for ViewSampler {
    fn default() -> Self {
        Self {
            min_context: 4,
            max_context: 6,
            min_gap: [25, 45],
            max_gap: [45, 135],
            warm_up_steps: 30_000,
            num_targets: 6,
            window: Window::Consecutive,
        }
    }
}

impl ViewSampler {
    /// Checks that a long enough scene has views for every allowed number of contexts.
    ///
    /// # Errors
    /// The first invalid field.
    pub fn validate(&self) -> Result<(), BadConfig> {
        let Self { min_context, max_context, min_gap, max_gap, num_targets, .. } = *self;
        check_config(min_context >= 2, "min_context", min_context, || "use 2 or more".into())?;
        check_config(max_context >= min_context, "max_context", max_context, || {
            format!("use min_context = {min_context} or more")
        })?;
        check_config(num_targets > 0, "num_targets", 0, || "use 1 or more".into())?;
        for (key, count) in [("max_context", max_context), ("num_targets", num_targets)] {
            check_config(count <= MAX_VIEWS, key, count, || format!("use {MAX_VIEWS} or fewer"))?;
        }
        for (key, gap) in [("min_gap", min_gap), ("max_gap", max_gap)] {
            check_config(gap[0] <= gap[1], key, format!("{gap:?}"), || {
                "the second value must be at least the first".into()
            })?;
        }
        check_config(max_gap[0] >= min_gap[0] && max_gap[1] >= min_gap[1], "max_gap", format!("{max_gap:?}"), || {
            format!("use at least min_gap = {min_gap:?}")
        })?;
        for num_context in min_context..=max_context {
            let num_frames = min_gap[0] / self.gap_divisor(num_context) + 1;
            check_config(num_frames >= num_context, "min_gap", format!("{min_gap:?}"), || {
                let needed = (num_context - 1) * self.gap_divisor(num_context);
                format!("{num_context} distinct contexts need a gap of {needed} or more")
            })?;
        }
        Ok(())
    }

    /// Samples the number of contexts of the batch at `step`, uniform in `[min_context, max_context]`.
    pub fn num_context(&self, seed: u64, step: u64) -> usize {
        uniform_between(&mut step_rng(seed, step, "number of contexts"), self.min_context, self.max_context)
    }

    /// Returns the smallest and the largest gap at `step` of a batch with `num_context` contexts.
    ///
    /// As in `DepthSplat`, both are divided by `max_context / num_context`, rounded down.
    pub fn gap_bounds(&self, step: u64, num_context: usize) -> [usize; 2] {
        let divisor = self.gap_divisor(num_context);
        [self.min_gap, self.max_gap].map(|[init, last]| linear_warm_up(init, last, self.warm_up_steps, step) / divisor)
    }

    fn gap_divisor(&self, num_context: usize) -> usize {
        (self.max_context / num_context.max(1)).max(1)
    }

    /// Returns the smallest number of frames of a scene that is long enough at every step up to `last_step`, for every
    /// number of contexts.
    pub fn min_frames(&self, last_step: u64) -> usize {
        let gaps = (self.min_context..=self.max_context).map(|num_context| self.gap_bounds(last_step, num_context)[0]);
        gaps.max().unwrap_or(0) + 1
    }

    /// Samples the views of one item from a scene of `source`. Cameras are read only where they decide.
    ///
    /// # Errors
    /// [`DataError::NotEnoughFrames`] if the scene is not longer than the smallest gap at `step`, and the errors of reading
    /// the scene.
    pub fn sample(
        &self,
        source: &dyn SceneSource,
        scene: usize,
        step: u64,
        num_context: usize,
        rng: &mut impl Rng,
    ) -> Result<ViewIndices, DataError> {
        let poses = self.poses(source, scene)?;
        let num_frames = poses.as_ref().map_or_else(|| source.num_frames(scene), |poses| Ok(poses.len()))?;
        self.sample_frames(num_frames, poses.as_deref(), step, num_context, rng)
    }

    /// Samples the views of one item from a scene of `num_frames` frames: among consecutive ones or, of a scene with
    /// `poses`, among a frame and those nearest to it, as many as a range has.
    ///
    /// The contexts are distinct and sorted. The targets lie between the ends, inclusive, in the sampled order. Expects
    /// a sampler that passes [`validate`](Self::validate).
    fn sample_frames(
        &self,
        num_frames: usize,
        poses: Option<&[Pose]>,
        step: u64,
        num_context: usize,
        rng: &mut impl Rng,
    ) -> Result<ViewIndices, DataError> {
        let [min_gap, max_gap] = self.gap_bounds(step, num_context);
        if num_frames <= min_gap {
            return Err(DataError::NotEnoughFrames { needed: min_gap + 1, got: num_frames });
        }
        let gap = uniform_between(rng, min_gap, max_gap.min(num_frames - 1));
        let frames: Vec<usize> = if let Some(poses) = poses {
            let seed = uniform_below(rng, num_frames);
            ViewDistance::new(poses).nearest(poses, seed, gap + 1)
        } else {
            let left = uniform_below(rng, num_frames - gap);
            (left..=left + gap).collect()
        };
        let target = (0..self.num_targets).map(|_| frames[uniform_below(rng, gap + 1)]).collect();
        let inner = sample_distinct(rng, gap - 1, num_context - 2).into_iter().map(|offset| frames[offset + 1]);
        let context = std::iter::once(frames[0]).chain(inner).chain([frames[gap]]).collect();
        Ok(ViewIndices { context, target })
    }

    /// Samples the targets of stage 2 for stored contexts: frames between the first and the last context or, with
    /// [`Window::Nearest`], near a context, that are not context views. Targets repeat only if there are fewer such frames;
    /// without any, they are contexts.
    ///
    /// # Errors
    /// [`DataError::NotEnoughFrames`] if a context is not a frame of the scene, [`DataError::BadConfig`] for no contexts, and the
    /// errors of reading the scene.
    pub fn sample_targets(
        &self,
        source: &dyn SceneSource,
        scene: usize,
        context: &[usize],
        rng: &mut impl Rng,
    ) -> Result<Vec<usize>, DataError> {
        let poses = self.poses(source, scene)?;
        let candidates = target_candidates(context, source.num_frames(scene)?, poses.as_deref())?;
        Ok(sample_candidates(context, candidates, self.num_targets, rng))
    }

    /// Returns the poses of a scene where they decide.
    fn poses(&self, source: &dyn SceneSource, scene: usize) -> Result<Option<Vec<Pose>>, DataError> {
        Ok(match self.window {
            Window::Consecutive => None,
            Window::Nearest => Some(source.cameras(scene)?.iter().map(|camera| camera.c2w).collect()),
        })
    }
}

/// Returns the frames that are not contexts and lie between the first and the last context; of photos in any order, which have
/// `poses`, those as near to a context as the contexts are to each other.
fn target_candidates(context: &[usize], num_frames: usize, poses: Option<&[Pose]>) -> Result<Vec<usize>, DataError> {
    let (Some(&first), Some(&last)) = (context.iter().min(), context.iter().max()) else {
        return Err(BadConfig::new("context", "[]", "use 1 or more frames").into());
    };
    if last >= num_frames {
        return Err(DataError::NotEnoughFrames { needed: last + 1, got: num_frames });
    }
    let is_target = |frame: &usize| !context.contains(frame);
    let Some(poses) = poses else { return Ok((first..=last).filter(is_target).collect()) };
    let distance = ViewDistance::new(poses);
    let to_nearest = |frame: usize| {
        let others = context.iter().filter(|&&other| other != frame);
        others.map(|&other| distance.between(&poses[frame], &poses[other])).fold(f64::INFINITY, f64::min)
    };
    let reach = context.iter().map(|&frame| to_nearest(frame)).fold(0.0, f64::max);
    Ok((0..num_frames).filter(is_target).filter(|&frame| to_nearest(frame) <= reach).collect())
}

/// Samples `count` of `candidates`. They repeat only if there are fewer; without any, contexts are sampled with replacement.
fn sample_candidates(context: &[usize], mut candidates: Vec<usize>, count: usize, rng: &mut impl Rng) -> Vec<usize> {
    if candidates.len() >= count {
        return sample_from(rng, candidates, count);
    }
    if candidates.is_empty() {
        candidates = context.to_vec();
    }
    (0..count).map(|_| candidates[uniform_below(rng, candidates.len())]).collect()
}

#[cfg(test)]
mod tests;
