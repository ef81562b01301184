//! The groups that a view is rendered from: the nearest, or a mean of the nearest few where none is clearly nearer.

/// Differences in distance over which groups are blended, in the units of [`ViewDistance`].
const BLEND: f64 = 0.15;
/// Most groups that a frame is rendered from.
const MAX_BLENDED: usize = 3;

/// Returns the nearest groups and their shares of a frame, which add up to 1 and change continuously with the distances: a
/// share falls linearly to 0 where a group is [`BLEND`] farther than the nearest, or as far as the next after
/// [`MAX_BLENDED`].
pub(crate) fn group_shares(distances: &[f64]) -> Vec<(usize, f64)> {
    let mut order: Vec<usize> = (0..distances.len()).collect();
    order.sort_by(|&a, &b| distances[a].total_cmp(&distances[b]));
    let Some(&nearest) = order.first() else { return Vec::new() };
    let limit = distances[nearest] + BLEND;
    let limit = order.get(MAX_BLENDED).map_or(limit, |&next| limit.min(distances[next]));
    let rooms = order.into_iter().take(MAX_BLENDED).map(|group| (group, limit - distances[group]));
    let mut near: Vec<(usize, f64)> = rooms.filter(|(_, room)| *room > 0.0).collect();
    if near.is_empty() {
        return vec![(nearest, 1.0)];
    }
    let sum: f64 = near.iter().map(|(_, room)| room).sum();
    for (_, room) in &mut near {
        *room /= sum;
    }
    near
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_of_groups_add_up_and_change_continuously() {
        assert_eq!(group_shares(&[0.7]), [(0, 1.0)]);
        assert_eq!(group_shares(&[0.9, 0.2]), [(1, 1.0)], "far beyond the nearest");
        assert_eq!(group_shares(&[0.5, 0.5]), [(0, 0.5), (1, 0.5)]);
        assert_eq!(group_shares(&[0.5; 4]), [(0, 1.0)], "no room before the next after the most groups");
        let share = |distances: &[f64], group: usize| {
            group_shares(distances).iter().find(|(other, _)| *other == group).map_or(0.0, |(_, share)| *share)
        };
        // Two groups swap places, a third comes and goes. A share falls from 1 to 0 over a difference in distance of 0.05 to
        // 0.15, which a step changes by 0.002: the share changes by at most 0.04.
        for step in 0..1000 {
            let at = |step: i32| [f64::from(step) * 1e-3, 1.0 - f64::from(step) * 1e-3, 0.4, 0.45];
            let sum: f64 = (0..4).map(|group| share(&at(step), group)).sum();
            assert!((sum - 1.0).abs() < 1e-12, "step {step}: {sum}");
            for group in 0..4 {
                let jump = (share(&at(step), group) - share(&at(step + 1), group)).abs();
                assert!(jump < 0.05, "group {group} jumps by {jump} at step {step}");
            }
        }
    }
}
