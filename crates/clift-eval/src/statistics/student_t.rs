//! Student's t distribution with a whole number of degrees of freedom.

use special::Beta;

/// Returns the half-width of the central 95 % of the distribution: 12.7 for one degree of freedom, 1.96 for many.
pub(crate) fn t_quantile_95(degrees: usize) -> f64 {
    // P(|T| > t) is the regularized incomplete beta function of n / (n + t^2) (Abramowitz and Stegun 26.7.1).
    let n = degrees as f64;
    let x = 0.05_f64.inv_inc_beta(n / 2.0, 0.5, (n / 2.0).ln_beta(0.5));
    (n * (1.0 - x) / x).sqrt()
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
