//! Context views between the first and the last: random, spread in space, or spread in time.

use clift_core::sample_distinct;
use glam::DVec3;
use rand::Rng;
use serde::{Deserialize, Serialize};

/// Selection of the context frames between the first and the last.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum InnerViews {
    /// Uniform without replacement, as in the paper.
    #[default]
    Random,
    /// Farthest point sampling of the camera centres, starting from the first and the last frame.
    ///
    /// Departs from `DepthSplat`, whose search also chooses the ends, so that targets may lie outside of them.
    FarthestPoint,
    /// Even spacing by frame number.
    Even,
}

impl InnerViews {
    /// Returns whether the selection depends on the camera centres.
    pub fn needs_centres(self) -> bool {
        self == Self::FarthestPoint
    }

    /// Selects `count < right - left` different frames between `left` and `right`, in increasing order. `centres` are
    /// the camera centres of all frames of the scene; empty unless [`InnerViews::needs_centres`].
    pub(crate) fn choose(
        self,
        rng: &mut impl Rng,
        left: usize,
        right: usize,
        count: usize,
        centres: &[DVec3],
    ) -> Vec<usize> {
        let gap = right - left;
        match self {
            Self::Random => sample_distinct(rng, gap - 1, count).into_iter().map(|offset| left + 1 + offset).collect(),
            // Rounded half up. Steps are at least one frame, so frames do not repeat.
            Self::Even => (1..=count).map(|view| left + (2 * view * gap + count + 1) / (2 * (count + 1))).collect(),
            Self::FarthestPoint => farthest_points(left, right, count, centres),
        }
    }
}

/// Selects frames by farthest point sampling; the first of equally far frames.
fn farthest_points(left: usize, right: usize, count: usize, centres: &[DVec3]) -> Vec<usize> {
    let squared = |a: usize, b: usize| centres[a].distance_squared(centres[b]);
    let mut chosen = Vec::with_capacity(count);
    // Every inner frame with its squared distance to the nearest selected frame.
    let mut nearest: Vec<(usize, f64)> =
        (left + 1..right).map(|frame| (frame, squared(frame, left).min(squared(frame, right)))).collect();
    for _ in 0..count {
        let Some(farthest) = (0..nearest.len()).reduce(|a, b| if nearest[b].1 > nearest[a].1 { b } else { a }) else {
            break;
        };
        let (frame, _) = nearest.remove(farthest);
        chosen.push(frame);
        for (other, distance) in &mut nearest {
            *distance = distance.min(squared(*other, frame));
        }
    }
    chosen.sort_unstable();
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;
    use clift_core::step_rng;

    fn choose(inner: InnerViews, left: usize, right: usize, count: usize, centres: &[DVec3]) -> Vec<usize> {
        inner.choose(&mut step_rng(1, 2, "test"), left, right, count, centres)
    }

    #[test]
    fn even_views_have_equal_gaps_to_half_a_frame() {
        assert_eq!(choose(InnerViews::Even, 10, 19, 2, &[]), [13, 16]);
        assert_eq!(choose(InnerViews::Even, 0, 7, 6, &[]), [1, 2, 3, 4, 5, 6]);
        assert_eq!(choose(InnerViews::Even, 0, 5, 1, &[]), [3]); // 2.5, rounded up
        assert!(choose(InnerViews::Even, 3, 9, 0, &[]).is_empty());
        for gap in 1..60 {
            for count in 0..gap {
                let inner = choose(InnerViews::Even, 5, 5 + gap, count, &[]);
                for (index, frame) in inner.iter().enumerate() {
                    let ideal = 5.0 + (index + 1) as f64 * gap as f64 / (count + 1) as f64;
                    assert!((*frame as f64 - ideal).abs() <= 0.5, "{inner:?} in a gap of {gap}");
                }
                let all: Vec<usize> = [5].into_iter().chain(inner).chain([5 + gap]).collect();
                assert!(all.is_sorted_by(|a, b| a < b), "{all:?}");
            }
        }
    }

    #[test]
    fn farthest_points_avoid_a_resting_camera() {
        // The camera rests at 0 for six frames, then moves in steps of one.
        let path = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 4.0];
        let centres: Vec<DVec3> = path.iter().map(|&x| x * DVec3::X).collect();
        assert_eq!(choose(InnerViews::FarthestPoint, 0, 9, 1, &centres), [7]);
        assert_eq!(choose(InnerViews::FarthestPoint, 0, 9, 3, &centres), [6, 7, 8]);
        // A frame far off the path comes first.
        let mut detour = centres;
        detour[3] = 9.0 * DVec3::Y;
        assert_eq!(choose(InnerViews::FarthestPoint, 0, 9, 1, &detour), [3]);
    }
}
