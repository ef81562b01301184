//! The training curves of a run.

use maud::{Markup, html};

use crate::report::plot::{Look, Mark, Plot, Series};

/// Largest number of points of a line; more steps are averaged.
const MAX_POINTS: usize = 200;

/// PSNR of a stage over its steps.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TrainingCurve {
    /// Name of the stage.
    pub stage: &'static str,
    /// Step and PSNR of the training batches, in dB.
    pub training: Vec<(u64, f64)>,
    /// Step and PSNR of the validation views, in dB.
    pub validation: Vec<(u64, f64)>,
}

/// Returns a plot per stage; nothing without curves.
pub fn section(curves: &[TrainingCurve]) -> Markup {
    html! {
        @if !curves.is_empty() {
            h2 { "Training" }
            div.figures {
                @for curve in curves {
                    section { h3 { (curve.stage) } (plot(curve).to_html()) }
                }
            }
            p.note {
                "Training: batches with few or many tokens per view, averaged over "
                "neighbouring steps. Validation: " code { "eval.num_validation_scenes" } " scenes."
            }
        }
    }
}

fn plot(curve: &TrainingCurve) -> Plot {
    let series = [("validation", Look::ALL[0], &curve.validation), ("training", Look::LINE, &curve.training)];
    let series = series.into_iter().filter(|(.., points)| !points.is_empty()).map(|(name, look, points)| Series {
        name: name.into(),
        look,
        is_joined: true,
        marks: averaged(points).into_iter().map(|(x, y)| mark(name, x, y)).collect(),
    });
    Plot {
        title: format!("PSNR against the steps of {}, in training and validation", curve.stage),
        x_label: "step",
        series: series.collect(),
        ..Plot::default()
    }
}

fn mark(name: &str, x: f64, y: f64) -> Mark {
    Mark { x, y, error: None, title: format!("{name}, step {x:.0}: {y:.2} dB") }
}

/// Averages neighbouring points down to at most `MAX_POINTS`. Points that are not finite are left out.
fn averaged(points: &[(u64, f64)]) -> Vec<(f64, f64)> {
    let finite: Vec<(f64, f64)> =
        points.iter().filter(|(_, psnr)| psnr.is_finite()).map(|&(step, psnr)| (step as f64, psnr)).collect();
    let size = finite.len().div_ceil(MAX_POINTS).max(1);
    let mean =
        |some: &[(f64, f64)], value: fn(&(f64, f64)) -> f64| some.iter().map(value).sum::<f64>() / some.len() as f64;
    finite.chunks(size).map(|some| (mean(some, |point| point.0), mean(some, |point| point.1))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_curves_are_averaged_and_non_finite_points_left_out() {
        let points: Vec<(u64, f64)> = (1..=1000).map(|step| (step, step as f64)).collect();
        let short = averaged(&points);
        assert_eq!((short.len(), short[0], short[199]), (200, (3.0, 3.0), (998.0, 998.0)));
        assert_eq!(averaged(&[(1, f64::NAN), (2, 5.0), (3, f64::INFINITY)]), [(2.0, 5.0)]);
    }
}
