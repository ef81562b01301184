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
        let exact = |points: &[(f64, f64)]| {
            pareto_front(&points.iter().map(|&(cost, quality)| ([cost; 2], quality)).collect::<Vec<_>>())
        };
        // Dominated: more cost for less, for as much, and as much cost for less.
        assert_eq!(exact(&[(3.0, 5.0), (1.0, 2.0), (2.0, 1.0), (3.5, 5.0), (3.0, 4.0), (9.0, 9.0)]), [0, 1, 5]);
        let nan = f64::NAN;
        assert_eq!(exact(&[(1.0, 2.0), (1.0, 2.0), (nan, 9.0), (0.5, nan)]), [0]);
        assert_eq!(exact(&[]), [0; 0]);
    }

    #[test]
    fn overlapping_costs_do_not_differ() {
        let front = |costs: [[f64; 2]; 2]| pareto_front(&[(costs[0], 20.0), (costs[1], 21.0)]);
        assert_eq!(front([[1.0, 2.0], [1.5, 2.5]]), [1], "the first is not clearly cheaper");
        assert_eq!(front([[1.0, 2.0], [2.1, 2.5]]), [0, 1]);
        assert_eq!(front([[2.1, 2.5], [1.0, 2.0]]), [1]);
    }
}
