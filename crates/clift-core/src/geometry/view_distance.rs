//! Distance between views of one place: near views show the same things.

use crate::geometry::pose::Pose;
use crate::statistics::median;

/// Measures how far apart views of a place are: the distance of their centers over the extent of the place, plus the angle
/// between their viewing directions in radians.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ViewDistance {
    /// Median distance of the centers from their mean.
    extent: f64,
}

impl ViewDistance {
    /// Measures the extent of a place by its views.
    pub fn new(views: &[Pose]) -> Self {
        let mean = views.iter().map(|view| view.translation / views.len() as f64).sum();
        let distances: Vec<f64> = views.iter().map(|view| view.translation.distance(mean)).collect();
        // Views that turn in place differ by their angles alone.
        Self { extent: median(&distances).max(f64::MIN_POSITIVE) }
    }

    /// Returns the distance of two views.
    pub fn between(&self, a: &Pose, b: &Pose) -> f64 {
        a.translation.distance(b.translation) / self.extent + a.rotation.z_axis.angle_between(b.rotation.z_axis)
    }

    /// Returns the indices of view `seed` and of the `num_views - 1` views nearest to it, in ascending order.
    pub fn nearest(&self, views: &[Pose], seed: usize, num_views: usize) -> Vec<usize> {
        let mut others: Vec<usize> = (0..views.len()).filter(|&view| view != seed).collect();
        let to_seed = |view: usize| self.between(&views[view], &views[seed]);
        others.sort_by(|&a, &b| to_seed(a).total_cmp(&to_seed(b)));
        others.truncate(num_views - 1);
        others.push(seed);
        others.sort_unstable();
        others
    }

    /// Returns the distance of a view from a group of views: their mean distance plus the smallest.
    pub fn to_group<'a>(&self, view: &Pose, group: impl IntoIterator<Item = &'a Pose>) -> f64 {
        let distances: Vec<f64> = group.into_iter().map(|other| self.between(view, other)).collect();
        let sum: f64 = distances.iter().sum();
        sum / distances.len() as f64 + distances.iter().copied().fold(f64::INFINITY, f64::min)
    }
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec3};

    use super::*;

    fn view(x: f64, yaw_deg: f64) -> Pose {
        Pose { rotation: DMat3::from_rotation_y(yaw_deg.to_radians()), translation: DVec3::X * x }
    }

    #[test]
    fn distances_add_centers_over_the_extent_and_angles() {
        // Centers 2, 1, 1 and 2 from their mean: a median of 1.5.
        let views = [view(-2.0, 0.0), view(-1.0, 0.0), view(1.0, 0.0), view(2.0, 90.0)];
        let distance = ViewDistance::new(&views);
        for (a, b, expected) in [(0, 0, 0.0), (0, 1, 1.0 / 1.5), (2, 3, 1.0 / 1.5 + std::f64::consts::FRAC_PI_2)] {
            assert!((distance.between(&views[a], &views[b]) - expected).abs() < 1e-12, "{a} to {b}");
        }
        let expected = 0.5 / 1.5;
        assert!((distance.to_group(&views[0], &views[..2]) - expected).abs() < 1e-12, "mean plus smallest");
        assert_eq!((distance.nearest(&views, 2, 2), distance.nearest(&views, 0, 3)), (vec![1, 2], vec![0, 1, 2]));
        let turning = [view(5.0, 0.0), view(5.0, 30.0)];
        let angle = ViewDistance::new(&turning).between(&turning[0], &turning[1]);
        assert!((angle.to_degrees() - 30.0).abs() < 1e-9, "{angle}");
    }
}
