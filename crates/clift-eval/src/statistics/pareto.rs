//! The Pareto front of cost and quality.

/// Returns the indices of the points `(cost, quality)` on the front, by ascending cost: no other point has at most the cost
/// and at least the quality. Of equal points the first counts; points with a NaN or an infinity are ignored.
pub fn pareto_front(points: &[(f64, f64)]) -> Vec<usize> {
    let is_finite = |&i: &usize| points[i].0.is_finite() && points[i].1.is_finite();
    let mut order: Vec<usize> = (0..points.len()).filter(is_finite).collect();
    order.sort_by(|&a, &b| points[a].0.total_cmp(&points[b].0).then(points[b].1.total_cmp(&points[a].1)));
    let mut best = f64::NEG_INFINITY;
    order.retain(|&i| {
        let is_better = points[i].1 > best;
        best = best.max(points[i].1);
        is_better
    });
    order
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
        assert_eq!(pareto_front(&points).into_iter().map(|i| points[i]).collect::<Vec<_>>(), expected);
        assert_eq!(pareto_front(&[(1.0, 2.0), (1.0, 2.0), (f64::NAN, 9.0), (0.5, f64::NAN)]), [0]);
        assert_eq!(pareto_front(&[]), [0; 0]);
    }
}
