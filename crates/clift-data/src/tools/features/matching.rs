//! Mutual nearest descriptors.

use crate::tools::features::descriptor::Descriptor;

/// Largest distance of the nearest descriptor over that of the second nearest (Lowe's ratio test).
const RATIO: f64 = 0.8;

/// Returns the pairs of mutual nearest descriptors that pass the ratio test both ways, in the order of the first list.
pub(crate) fn match_mutually(first: &[Descriptor], second: &[Descriptor]) -> Vec<(usize, usize)> {
    let mut forward = vec![Nearest::default(); first.len()];
    let mut backward = vec![Nearest::default(); second.len()];
    for (a, mine) in first.iter().enumerate() {
        for (b, other) in second.iter().enumerate() {
            let distance = mine.squared_distance(other);
            forward[a].update(b, distance);
            backward[b].update(a, distance);
        }
    }
    let clear = |nearest: &Nearest| nearest.is_clear().then_some(nearest.index);
    let pair = |(a, nearest): (usize, &Nearest)| {
        let b = clear(nearest)?;
        (clear(&backward[b]) == Some(a)).then_some((a, b))
    };
    forward.iter().enumerate().filter_map(pair).collect()
}

/// The nearest descriptor so far, its distance, and the distance of the second nearest.
#[derive(Clone, Copy)]
struct Nearest {
    index: usize,
    distance: i32,
    second: i32,
}

impl Default for Nearest {
    fn default() -> Self {
        Self { index: usize::MAX, distance: i32::MAX, second: i32::MAX }
    }
}

impl Nearest {
    fn update(&mut self, index: usize, distance: i32) {
        if distance < self.distance {
            *self = Self { index, distance, second: self.distance };
        } else {
            self.second = self.second.min(distance);
        }
    }

    fn is_clear(&self) -> bool {
        self.index != usize::MAX && f64::from(self.distance) < RATIO * RATIO * f64::from(self.second)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn nearest(distances: &[i32]) -> Nearest {
        let mut nearest = Nearest::default();
        for (index, distance) in distances.iter().enumerate() {
            nearest.update(index, *distance);
        }
        nearest
    }

    #[test]
    fn ratio_test_rejects_similar_second_matches() {
        assert!(nearest(&[100, 63, 200]).is_clear() && nearest(&[100, 63, 200]).index == 1);
        assert!(!nearest(&[100, 65, 200]).is_clear()); // sqrt(0.65) > 0.8
        assert!(!nearest(&[50, 50]).is_clear());
        assert!(!nearest(&[0, 0]).is_clear(), "two equal descriptors are ambiguous");
        assert!(nearest(&[7]).is_clear() && !nearest(&[]).is_clear());
    }
}
