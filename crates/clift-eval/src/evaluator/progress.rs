//! Progress of an evaluation, and the processes that share its scenes.

use clift_data::SkippedScene;
use serde::{Deserialize, Serialize};

use crate::error::EvalError;
use crate::statistics::eval_results::EvalResults;

/// Receiver of progress, with the request to stop, and exchange with the other processes of an evaluation.
pub trait EvalProgress {
    /// Reports that `scenes` of `total` are done. The first call has 0 scenes.
    fn done(&mut self, scenes: usize, total: usize);

    /// Reports a line of text.
    fn note(&mut self, text: &str);

    /// Reports a skipped scene.
    fn skipped(&mut self, key: &str, reason: &str);

    /// Returns whether to stop the evaluation.
    fn is_interrupted(&self) -> bool;

    /// Returns the place of this process among those that share the scenes.
    fn process(&self) -> Process {
        Process { rank: 0, count: 1 }
    }

    /// Returns the results of all processes, by rank.
    fn gather(&mut self, own: SharedScenes) -> Result<Vec<SharedScenes>, EvalError> {
        Ok(vec![own])
    }
}

/// The place of a process among those that share an evaluation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Process {
    /// Number of the process, from 0. The first one writes the files.
    pub rank: usize,
    /// Number of processes.
    pub count: usize,
}

impl Process {
    /// Returns whether this process measures a scene. The first process has the first `num_figures` scenes, whose images
    /// it draws; the other processes catch up before the scenes go round.
    pub(crate) fn measures(self, scene: usize, num_figures: usize) -> bool {
        let Some(further) = scene.checked_sub(num_figures) else { return self.rank == 0 };
        let num_others = self.count - 1;
        self.rank
            == match further.checked_sub(num_figures * num_others) {
                None => 1 + further % num_others,
                Some(further) => further % self.count,
            }
    }
}

/// What a process has measured of the scenes that several share.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct SharedScenes {
    pub(crate) results: EvalResults,
    /// Scenes that could not be read, by their place in the evaluation.
    pub(crate) skipped: Vec<(usize, SkippedScene)>,
    /// The scene before which the process was asked to stop.
    pub(crate) interrupted_at: Option<usize>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_scene_is_measured_once_and_figures_by_the_first_process() {
        for (count, num_figures, num_scenes) in [(1, 3, 10), (2, 3, 10), (3, 0, 7), (4, 2, 40), (3, 8, 5)] {
            let of_rank = |rank| {
                let process = Process { rank, count };
                (0..num_scenes).filter(|&scene| process.measures(scene, num_figures)).collect::<Vec<_>>()
            };
            let ranks: Vec<_> = (0..count).map(of_rank).collect();
            let mut all = ranks.concat();
            all.sort_unstable();
            assert!(all.into_iter().eq(0..num_scenes));
            assert!((0..num_figures.min(num_scenes)).all(|scene| ranks[0].contains(&scene)));
            if num_figures * count <= num_scenes {
                let sizes = ranks.iter().map(Vec::len);
                assert!(sizes.clone().max().unwrap() - sizes.min().unwrap() <= 1, "{count} {num_figures}");
            }
        }
    }
}
