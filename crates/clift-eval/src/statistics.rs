//! What is said of the repetitions of a row.

/// The middle of the samples: the mean of the two middle ones where their number is even. NaN for none.
pub fn median(samples: &[f64]) -> f64 {
    let sorted = sorted(samples);
    let middle = sorted.len() / 2;
    match sorted.len() {
        0 => f64::NAN,
        count if count.is_multiple_of(2) => f64::midpoint(sorted[middle - 1], sorted[middle]),
        _ => sorted[middle],
    }
}

/// The smallest sample that 95 % of the samples do not exceed (nearest rank): the largest of fewer than 20. NaN
/// for none.
pub fn p95(samples: &[f64]) -> f64 {
    let sorted = sorted(samples);
    // In whole numbers: 0.95 * 20 is above 19 in binary.
    let rank = (sorted.len() * 95).div_ceil(100);
    rank.checked_sub(1).map_or(f64::NAN, |index| sorted[index])
}

fn sorted(samples: &[f64]) -> Vec<f64> {
    let mut sorted = samples.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_median_is_the_middle_whatever_the_order() {
        assert_eq!(median(&[3.0, 1.0, 2.0]), 2.0);
        assert_eq!(median(&[4.0, 1.0, 3.0, 2.0]), 2.5);
        assert_eq!(median(&[7.0]), 7.0);
        assert!(median(&[]).is_nan());
    }

    #[test]
    fn the_95th_percentile_is_the_sample_of_the_nearest_rank() {
        let samples = |count: u32| (1..=count).rev().map(f64::from).collect::<Vec<_>>();
        let expected = [(1, 1.0), (5, 5.0), (19, 19.0), (20, 19.0), (21, 20.0), (100, 95.0), (101, 96.0)];
        for (count, expected) in expected {
            assert_eq!(p95(&samples(count)), expected, "of {count}");
        }
        assert!(p95(&[]).is_nan());
    }
}
