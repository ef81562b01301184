//! The paired difference of a metric.
//!
//! Scenes differ far more than methods. The standard error is therefore computed from the differences within scenes, not
//! from two means.

use clift_core::{mean, standard_error};
use serde::Serialize;
use special::Beta;

use crate::statistics::eval_results::SceneViews;
use crate::statistics::view_metrics::{Metric, ViewMetrics};

/// Returns the views that both have, by scene: the view of `a`, then that of `b`. Scenes without a common view are left out.
pub(crate) fn common_views(a: &SceneViews, b: &SceneViews) -> Vec<Vec<[ViewMetrics; 2]>> {
    let scenes = a.iter().filter_map(|(scene, views)| Some((views, b.get(scene)?)));
    let common = scenes.map(|(views, others)| {
        views.iter().filter_map(|(frame, view)| Some([*view, *others.get(frame)?])).collect::<Vec<_>>()
    });
    common.filter(|views| !views.is_empty()).collect()
}

#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct MetricDifference {
    /// Mean over scenes of the first side.
    pub a: f64,
    /// Mean over scenes of the second side.
    pub b: f64,
    /// Mean over scenes of the second minus the first.
    pub mean: f64,
    /// Standard error of `mean`; null for a single scene.
    pub stderr: Option<f64>,
    /// Ends of the 95 % confidence interval of `mean`, from Student's t distribution; null for a single scene.
    pub interval: Option<[f64; 2]>,
}

impl MetricDifference {
    /// Averages the common views of each scene, then the scenes. Views without the metric on either side are ignored;
    /// `None` if none is left.
    pub(crate) fn new(common: &[Vec<[ViewMetrics; 2]>], metric: Metric) -> Option<Self> {
        let values = |[a, b]: &[ViewMetrics; 2]| {
            let (a, b) = (metric(a)?, metric(b)?);
            Some([a, b, b - a])
        };
        let of_scene = |views: &Vec<_>| column_means(&views.iter().filter_map(values).collect::<Vec<_>>());
        let scenes: Vec<[f64; 3]> = common.iter().filter_map(of_scene).collect();
        let [a, b, mean] = column_means(&scenes)?;
        let stderr = standard_error(&scenes.iter().map(|[.., difference]| *difference).collect::<Vec<_>>());
        let interval = stderr.map(|stderr| {
            let half = t_quantile_95(scenes.len() - 1) * stderr;
            [mean - half, mean + half]
        });
        Some(Self { a, b, mean, stderr, interval })
    }

    pub fn is_clear(&self) -> bool {
        self.interval.is_some_and(|[low, high]| low > 0.0 || high < 0.0)
    }
}

/// Returns the half-width of the central 95 % of Student's t distribution: 12.7 for one degree of freedom, 1.96 for many.
fn t_quantile_95(degrees: usize) -> f64 {
    // P(|T| > t) is the regularized incomplete beta function of n / (n + t^2) (Abramowitz and Stegun 26.7.1).
    let n = degrees as f64;
    let x = 0.05_f64.inv_inc_beta(n / 2.0, 0.5, (n / 2.0).ln_beta(0.5));
    (n * (1.0 - x) / x).sqrt()
}

fn column_means(rows: &[[f64; 3]]) -> Option<[f64; 3]> {
    let column = |i: usize| mean(&rows.iter().map(|row| row[i]).collect::<Vec<_>>());
    Some([column(0)?, column(1)?, column(2)?])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::statistics::view_metrics::PSNR;

    #[test]
    fn consistent_differences_are_clear() {
        let view = |psnr| ViewMetrics::quality(psnr, None);
        let of = |shift: f64| {
            let scene = |i: u32| vec![[view(f64::from(i)), view(f64::from(i) + shift + 0.01 * f64::from(i % 2))]];
            MetricDifference::new(&(0..30).map(scene).collect::<Vec<_>>(), PSNR).unwrap()
        };
        assert!(of(0.5).is_clear() && of(-0.5).is_clear() && !of(-0.005).is_clear());
        let single = MetricDifference::new(&[vec![[view(1.0), view(2.0)]]], PSNR).unwrap();
        assert_eq!((single.mean, single.interval, single.is_clear()), (1.0, None, false));
    }

    #[test]
    fn quantiles_equal_scipy() {
        // scipy.stats.t.ppf(0.975, n)
        for (degrees, expected) in [(1, 12.706_204_736), (2, 4.302_652_73), (30, 2.042_272_456), (6473, 1.960_330_539)]
        {
            let quantile = t_quantile_95(degrees);
            assert!((quantile - expected).abs() < 1e-6, "{degrees}: {quantile} is not {expected}");
        }
    }
}
