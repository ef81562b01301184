//! Student's t distribution with a whole number of degrees of freedom.

/// Returns the half-width of the central 95 % of the distribution: 12.7 for one degree of freedom, 1.96 for many.
pub(crate) fn t_quantile_95(degrees: usize) -> f64 {
    let (mut low, mut high) = (0.0, 13.0);
    // 60 bisections of 13 are exact to rounding.
    for _ in 0..60 {
        let middle = f64::midpoint(low, high);
        if central(middle, degrees) < 0.95 {
            low = middle;
        } else {
            high = middle;
        }
    }
    f64::midpoint(low, high)
}

/// Returns the probability of `|T| < t` (Abramowitz and Stegun 26.7.3 and 26.7.4).
fn central(t: f64, degrees: usize) -> f64 {
    let (sin, cos) = (t / (degrees as f64).sqrt()).atan().sin_cos();
    let square = cos * cos;
    // 1 + 1/2 c^2 + 1*3/(2*4) c^4 + .. for even degrees, c (1 + 2/3 c^2 + ..) for odd ones.
    let is_odd = degrees % 2 == 1;
    let first = if is_odd { cos } else { 1.0 };
    let start = if is_odd { 2 } else { 1 };
    let (mut sum, mut term) = (0.0, first);
    for i in 0..degrees / 2 {
        sum += term;
        let over = (start + 2 * i) as f64;
        term *= square * over / (over + 1.0);
    }
    if is_odd { std::f64::consts::FRAC_2_PI * (sin.atan2(cos) + sin * sum) } else { sin * sum }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_equal_scipy() {
        // scipy.stats.t.ppf(0.975, n)
        for (degrees, expected) in [
            (1, 12.706_204_736),
            (2, 4.302_652_73),
            (3, 3.182_446_305),
            (4, 2.776_445_105),
            (5, 2.570_581_836),
            (29, 2.045_229_642),
            (30, 2.042_272_456),
            (131, 1.978_238_539),
            (6473, 1.960_330_539),
        ] {
            let quantile = t_quantile_95(degrees);
            assert!((quantile - expected).abs() < 1e-6, "{degrees}: {quantile} is not {expected}");
        }
    }
}
