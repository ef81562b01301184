//! Groups of neighbouring views, each encoded as in training: views far apart, encoded together, come out as fog.

use std::collections::BTreeSet;

use clift_core::{Pose, ViewDistance};

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

/// Divides views into groups of neighbours, as few as possible of at most `num_views` views each, of about equal sizes, in
/// ascending order each.
///
/// Of all groups of a view and its nearest neighbours among the views left, the widest comes next: isolated views are grouped
/// while they still have neighbours.
pub(crate) fn neighbour_partition(views: &[Pose], num_views: usize) -> Vec<Vec<usize>> {
    let distance = ViewDistance::new(views);
    let mut left: Vec<usize> = (0..views.len()).collect();
    let num_groups = views.len().div_ceil(num_views);
    let mut groups = Vec::with_capacity(num_groups);
    for group in 0..num_groups {
        let size = left.len().div_ceil(num_groups - group);
        let poses: Vec<Pose> = left.iter().map(|&view| views[view]).collect();
        let width = |group: &Vec<usize>, seed: usize| -> f64 {
            group.iter().map(|&view| distance.between(&poses[view], &poses[seed])).sum()
        };
        let of_seeds = (0..poses.len()).map(|seed| {
            let group = distance.nearest(&poses, seed, size);
            (width(&group, seed), group)
        });
        let Some((_, group)) = of_seeds.max_by(|a, b| a.0.total_cmp(&b.0)) else { break };
        groups.push(group.iter().map(|&view| left[view]).collect::<Vec<_>>());
        let taken = groups.last().into_iter().flatten().copied().collect::<BTreeSet<_>>();
        left.retain(|view| !taken.contains(view));
    }
    groups.sort();
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
    fn a_partition_has_every_view_once_beside_its_neighbours() {
        let groups = |places: &[f64], num_views| neighbour_partition(&on_a_line(places), num_views);
        let steady: Vec<f64> = (0..10).map(f64::from).collect();
        assert_eq!(groups(&steady, 4), [vec![0, 1, 2, 3], vec![4, 5, 6], vec![7, 8, 9]]);
        assert_eq!(groups(&steady[..3], 4), [vec![0, 1, 2]]);
        assert!(groups(&[], 4).is_empty());
        // The two far views are served before the others choose.
        assert_eq!(groups(&[5.0, 0.0, 5.1, 0.1, 5.2, 5.3, 0.2, 0.3], 4), [vec![0, 2, 4, 5], vec![1, 3, 6, 7]]);
        for count in 1..40 {
            let groups = groups(&(0..count).map(|i| f64::from(i * i % 17)).collect::<Vec<_>>(), 4);
            let mut all: Vec<usize> = groups.iter().flatten().copied().collect();
            all.sort_unstable();
            assert_eq!(all, (0..count as usize).collect::<Vec<_>>());
            assert!(groups.iter().all(|group| group.len() <= 4 && (count < 5 || group.len() > 1)), "{groups:?}");
        }
    }

    #[test]
    fn groups_are_neighbours_and_contain_every_view() {
        let steady: Vec<f64> = (0..10).map(f64::from).collect();
        let groups = |places: &[f64], count| neighbour_groups(&on_a_line(places), 4, count, true);
        assert_eq!(groups(&steady, 1), [vec![0, 1, 2, 3], vec![2, 3, 4, 5], vec![6, 7, 8, 9]], "as few as needed");
        let more = groups(&steady, 6);
        assert!(more.iter().all(|group| group.len() == 4 && group[3] - group[0] <= 4), "{more:?}");
        assert!((0..10).all(|view| more.iter().any(|group| group.contains(&view))), "{more:?}");
        assert_eq!(groups(&steady[..3], 5), [vec![0, 1, 2]], "equal groups count once");
        assert_eq!(neighbour_groups(&on_a_line(&steady), 4, 1, false), [[0, 1, 2, 3]], "others are left out");
        // Two clusters far apart are not mixed.
        let apart = groups(&[0.0, 0.1, 0.2, 0.3, 9.0, 9.1, 9.2, 9.3], 2);
        assert_eq!(apart, [vec![0, 1, 2, 3], vec![4, 5, 6, 7]]);
    }
}
