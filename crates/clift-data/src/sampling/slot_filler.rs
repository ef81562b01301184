//! Retry loop of a batch slot: other scenes replace unusable ones.

use std::collections::BTreeSet;

use crate::skip_report::SkippedScene;

/// Tries scenes for a batch slot until one can be read.
///
/// A slot gives up after `min_attempts` attempts and `min_scenes` different scenes, whichever comes later, but at the
/// latest after the attempt numbered `max_attempts - 1`.
#[derive(Clone, Copy, Debug)]
pub struct SlotFiller {
    /// Fewest attempts before the slot gives up. Among these a scene may be tried again, with other views; later
    /// attempts skip the scenes that have been tried.
    pub min_attempts: u32,
    /// Fewest different scenes before the slot gives up.
    pub min_scenes: usize,
    /// Upper limit of the attempt number, which also counts the scenes that are not tried again.
    pub max_attempts: u32,
}

/// The error of a slot without any usable scene.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NoUsableScene {
    /// Scenes tried, repeated ones included.
    pub attempts: u32,
    /// The last of them.
    pub last: SkippedScene,
}

impl SlotFiller {
    /// Reads scenes until `read` succeeds and returns the result. Failed scenes are appended to `skipped`.
    ///
    /// `scene` returns the scene of an attempt. Both closures must derive their randomness from the number of the
    /// attempt alone, so that retries of one slot do not change other slots.
    ///
    /// # Errors
    /// [`NoUsableScene`] with the last error.
    pub fn fill<T>(
        &self,
        scene: impl Fn(u32) -> usize,
        mut read: impl FnMut(usize, u32) -> Result<T, SkippedScene>,
        skipped: &mut Vec<SkippedScene>,
    ) -> Result<T, NoUsableScene> {
        let mut tried = BTreeSet::new();
        let mut failed =
            NoUsableScene { attempts: 0, last: SkippedScene { key: String::new(), reason: String::new() } };
        for attempt in 0..self.max_attempts {
            if failed.attempts >= self.min_attempts && tried.len() >= self.min_scenes {
                break;
            }
            let scene = scene(attempt);
            if !tried.insert(scene) && attempt >= self.min_attempts {
                continue;
            }
            failed.attempts += 1;
            match read(scene, attempt) {
                Ok(item) => return Ok(item),
                Err(skip) => {
                    skipped.push(skip.clone());
                    failed.last = skip;
                }
            }
        }
        Err(failed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The attempts at which scenes are read when none can be used.
    fn attempts(filler: SlotFiller, scene: impl Fn(u32) -> usize) -> Vec<u32> {
        let (mut read, mut skipped) = (Vec::new(), Vec::new());
        let skip = |scene: usize| SkippedScene { key: scene.to_string(), reason: "torn".into() };
        let refuse = |scene: usize, attempt: u32| {
            read.push(attempt);
            Err::<(), _>(skip(scene))
        };
        let failed = filler.fill(&scene, refuse, &mut skipped).unwrap_err();
        let last = *read.last().unwrap();
        assert_eq!(failed, NoUsableScene { attempts: read.len() as u32, last: skip(scene(last)) });
        assert_eq!(skipped.len(), read.len());
        read
    }

    #[test]
    fn later_attempts_skip_tried_scenes() {
        let filler = SlotFiller { min_attempts: 3, min_scenes: 4, max_attempts: 100 };
        assert_eq!(attempts(filler, |attempt| attempt as usize / 2), [0, 1, 2, 4, 6]);
        assert_eq!(attempts(filler, |_| 7), [0, 1, 2]);
        assert_eq!(attempts(SlotFiller { min_scenes: 0, ..filler }, |attempt| attempt as usize), [0, 1, 2]);
    }
}
