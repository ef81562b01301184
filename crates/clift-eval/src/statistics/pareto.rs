//! The Pareto front of cost and quality.

/// Returns the indices of the points `(cost, quality)` on the front, ascending. The cost is an interval, such as its
/// quartiles: costs whose intervals overlap do not differ. A point is on the front if every other point has a lower quality or
/// a higher cost. Of points with equal quality the cheapest counts, by the middle of its interval; points with a NaN or an infinity
/// are ignored.
pub fn pareto_front(points: &[([f64; 2], f64)]) -> Vec<usize> {
    let is_finite = |&i: &usize| points[i].0.iter().all(|cost| cost.is_finite()) && points[i].1.is_finite();
    let finite: Vec<usize> = (0..points.len()).filter(is_finite).collect();
    let middle = |i: usize| f64::midpoint(points[i].0[0], points[i].0[1]);
    let beats = |other: usize, i: usize| {
        let (([low, _], quality), ([_, high], least)) = (points[other], points[i]);
        let is_first = middle(other).total_cmp(&middle(i)).then(other.cmp(&i)).is_lt();
        (quality > least && low <= high) || (quality == least && is_first)
    };
    finite.iter().copied().filter(|&i| !finite.iter().any(|&other| other != i && beats(other, i))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_point_dominates_the_front() {
        // A grid of costs and qualities with ties, against the definition.
        let points: Vec<(f64, f64)> =
            (0..60_u32).map(|i| (f64::from(i * 7 % 11), f64::from(i * 13 % 17) - f64::from(i % 3))).collect();
        let beats = |a: (f64, f64), b: (f64, f64)| a.0 <= b.0 && a.1 >= b.1 && a != b;
        let mut expected: Vec<(f64, f64)> =
            points.iter().copied().filter(|&point| !points.iter().any(|&other| beats(other, point))).collect();
        expected.sort_by(|a, b| a.0.total_cmp(&b.0));
        expected.dedup();
        assert!(expected.len() > 1, "{expected:?}");
        let exact: Vec<_> = points.iter().map(|&(cost, quality)| ([cost; 2], quality)).collect();
        let mut found: Vec<_> = pareto_front(&exact).into_iter().map(|i| points[i]).collect();
        found.sort_by(|a, b| a.0.total_cmp(&b.0));
        assert_eq!(found, expected);
        let nan = f64::NAN;
        assert_eq!(pareto_front(&[([1.0; 2], 2.0), ([1.0; 2], 2.0), ([nan; 2], 9.0), ([0.5; 2], nan)]), [0]);
        assert_eq!(pareto_front(&[]), [0; 0]);
    }

    #[test]
    fn overlapping_costs_do_not_differ() {
        let front = |costs: [[f64; 2]; 2]| pareto_front(&[(costs[0], 20.0), (costs[1], 21.0)]);
        assert_eq!(front([[1.0, 2.0], [1.5, 2.5]]), [1], "the first is not clearly cheaper");
        assert_eq!(front([[1.0, 2.0], [2.1, 2.5]]), [0, 1]);
        assert_eq!(front([[2.1, 2.5], [1.0, 2.0]]), [1]);
    }
}
