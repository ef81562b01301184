//! Mutual nearest descriptors.

use crate::tools::features::descriptor::Descriptor;

/// Largest distance of the nearest descriptor over that of the second nearest (Lowe's ratio test).
const RATIO: f64 = 0.8;

/// Pairs that are each other's nearest and pass the ratio test in both directions, in the order of the first list.
pub(crate) fn mutual(first: &[Descriptor], second: &[Descriptor]) -> Vec<(usize, usize)> {
    let mut there = vec![Nearest::default(); first.len()];
    let mut back = vec![Nearest::default(); second.len()];
    for (a, mine) in first.iter().enumerate() {
        for (b, other) in second.iter().enumerate() {
            let distance = mine.squared_distance(other);
            there[a].see(b, distance);
            back[b].see(a, distance);
        }
    }
    let clear = |nearest: &Nearest| nearest.is_clear().then_some(nearest.place);
    let pair = |(a, nearest): (usize, &Nearest)| {
        let b = clear(nearest)?;
        (clear(&back[b]) == Some(a)).then_some((a, b))
    };
    there.iter().enumerate().filter_map(pair).collect()
}

/// The nearest descriptor so far, and the distance of the second nearest.
#[derive(Clone, Copy)]
struct Nearest {
    place: usize,
    distance: i32,
    second: i32,
}

impl Default for Nearest {
    fn default() -> Self {
        Self { place: usize::MAX, distance: i32::MAX, second: i32::MAX }
    }
}

impl Nearest {
    fn see(&mut self, place: usize, distance: i32) {
        if distance < self.distance {
            *self = Self { place, distance, second: self.distance };
        } else {
            self.second = self.second.min(distance);
        }
    }

    fn is_clear(&self) -> bool {
        self.place != usize::MAX && f64::from(self.distance) < RATIO * RATIO * f64::from(self.second)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn nearest(distances: &[i32]) -> Nearest {
        let mut nearest = Nearest::default();
        for (place, distance) in distances.iter().enumerate() {
            nearest.see(place, *distance);
        }
        nearest
    }

    #[test]
    fn the_nearest_counts_only_when_the_second_is_clearly_farther() {
        assert!(nearest(&[100, 63, 200]).is_clear() && nearest(&[100, 63, 200]).place == 1);
        assert!(!nearest(&[100, 65, 200]).is_clear()); // sqrt(0.65) > 0.8
        assert!(!nearest(&[50, 50]).is_clear());
        assert!(!nearest(&[0, 0]).is_clear(), "two equal ones are no match, however alike");
        assert!(nearest(&[7]).is_clear() && !nearest(&[]).is_clear());
    }
}
