//! The evaluated scenes and frames, and whether training has seen them.

use clift_data::{DataError, EvaluationItem, OpenedSource, SceneSource, Split, ViewIndices, even_views, even_views_of};
use serde::{Deserialize, Serialize};

/// What the figures of an evaluation were measured on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, strum::Display)]
#[serde(rename_all = "snake_case")]
pub enum EvalSplit {
    /// Scenes of the test split.
    #[strum(to_string = "test split")]
    Test,
    /// Frames of the training scenes that training never reads (`data.hold_out`).
    #[strum(to_string = "held-out frames of training scenes")]
    HeldOutFrames,
    /// Training scenes, with frames that training reads.
    #[strum(to_string = "training scenes")]
    Train,
    /// A data set without splits that is not the training data.
    #[strum(to_string = "data set without splits")]
    OtherData,
}

impl EvalSplit {
    /// Returns a warning if the figures do not measure generalization.
    pub fn warning(self) -> Option<&'static str> {
        (self == Self::Train).then_some("measured on training scenes: the figures do not show how the run generalizes")
    }
}

/// The scenes of an evaluation, and their frames that it may use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EvalFrames {
    /// The evaluated split.
    pub split: EvalSplit,
    /// Every n-th frame of a scene is held out of training, or of the contexts of a data set without splits; 0 for none.
    pub hold_out: usize,
}

impl EvalFrames {
    /// Scenes without frames held out of training.
    pub const fn whole(split: EvalSplit) -> Self {
        Self { split, hold_out: 0 }
    }

    /// Returns the frames of an opened split. `hold_out` is the `data.hold_out` of the run; `is_training_data` whether the
    /// run was trained on the data set.
    pub fn new(opened: &OpenedSource, split: Split, hold_out: usize, is_training_data: bool) -> Self {
        match (split, opened.shares_scenes) {
            (Split::Test, false) => Self::whole(EvalSplit::Test),
            (Split::Train, false) => Self::whole(EvalSplit::Train),
            _ if !is_training_data => Self::whole(EvalSplit::OtherData),
            (Split::Test, true) if hold_out > 0 => Self { split: EvalSplit::HeldOutFrames, hold_out },
            _ => Self { split: EvalSplit::Train, hold_out },
        }
    }

    /// Spreads the views of a scene without an index: held-out frames are targets only, and no views of training frames.
    pub(crate) fn views(
        &self,
        source: &dyn SceneSource,
        scene: usize,
        num_context: usize,
        num_targets: usize,
    ) -> Result<Option<ViewIndices>, DataError> {
        let num_frames = source.num_frames(scene)?;
        if self.hold_out == 0 {
            return Ok(even_views(num_frames, num_context, num_targets));
        }
        let held_out = source.held_out(scene, self.hold_out)?;
        let rest: Vec<usize> = (0..num_frames).filter(|frame| held_out.binary_search(frame).is_err()).collect();
        let targets = (self.split != EvalSplit::Train).then_some(&held_out[..]);
        Ok(even_views_of(&rest, targets, num_context, num_targets))
    }

    /// Returns the split of the views of an index: frames that training reads are not held-out frames.
    pub(crate) fn of_views(&self, source: &dyn SceneSource, items: &[EvaluationItem]) -> EvalSplit {
        let is_held_out = |item: &EvaluationItem| {
            let held_out = source.held_out(item.scene, self.hold_out).unwrap_or_default();
            item.views.target.iter().all(|frame| held_out.binary_search(frame).is_ok())
        };
        let is_measured = self.split != EvalSplit::HeldOutFrames || items.iter().all(is_held_out);
        if is_measured { self.split } else { EvalSplit::Train }
    }
}

#[cfg(test)]
mod tests {
    use clift_data::{SyntheticConfig, SyntheticSource};

    use super::*;

    #[test]
    fn held_out_frames_are_targets_and_no_contexts() {
        let rooms =
            |num_frames| SyntheticSource::new(SyntheticConfig { num_frames, ..SyntheticConfig::default() }).unwrap();
        let views = |split| EvalFrames { split, hold_out: 8 }.views(&rooms(50), 0, 4, 3).unwrap().unwrap();
        let held_out = views(EvalSplit::HeldOutFrames);
        assert_eq!(held_out, views(EvalSplit::OtherData), "as a run on this data would");
        assert!(held_out.target.iter().all(|frame| frame % 8 == 0) && held_out.target.len() == 3);
        let train = views(EvalSplit::Train);
        assert!(held_out.context.iter().chain(&train.context).chain(&train.target).all(|frame| frame % 8 != 0));
        let few =
            EvalFrames { split: EvalSplit::HeldOutFrames, hold_out: 8 }.views(&rooms(10), 0, 4, 3).unwrap().unwrap();
        assert_eq!(few.target, [0, 8], "as many as there are");
    }
}
