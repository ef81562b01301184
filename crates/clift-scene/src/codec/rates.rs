//! Loss of coded tokens, measured on renderings by token count and step when the codec is fitted.
// C counts, K steps

use clift_model::ModelError;

#[derive(Clone, Debug, PartialEq)]
pub struct RateTable {
    /// Ascending shares of all tokens, `[C]`.
    pub shares: Vec<f64>,
    /// Ascending steps, `[K]`.
    pub steps: Vec<f64>,
    /// Mean loss of PSNR in dB against rendering the same tokens without rounding, positive, `[C, K]`.
    pub loss: Vec<f64>,
}

/// Smallest loss in a table, in dB: logarithms are interpolated.
const MIN_LOSS_DB: f64 = 1e-6;
/// Largest and smallest step of a search, as a factor of the measured steps.
const STEP_MARGIN: f64 = 256.0;
const SEARCH_STEPS: usize = 60;

impl RateTable {
    /// Makes losses positive and ascending with the step: means over few views can be a little off.
    pub fn checked(mut self) -> Result<Self, ModelError> {
        let (counts, steps) = (self.shares.len(), self.steps.len());
        let ascending = |values: &[f64]| values[0] > 0.0 && values.windows(2).all(|pair| pair[0] < pair[1]);
        let is_finite = [&self.shares, &self.steps, &self.loss].into_iter().flatten().all(|value| value.is_finite());
        let is_table = counts > 0 && steps > 1 && self.loss.len() == counts * steps && is_finite;
        if !is_table || !ascending(&self.shares) || !ascending(&self.steps) {
            let value = format!("{counts} counts and {steps} steps");
            return Err(ModelError::BadConfig { key: "rates", value, fix: "fit the codec again".into() });
        }
        for losses in self.loss.chunks_exact_mut(steps) {
            let mut least = MIN_LOSS_DB;
            for loss in losses {
                *loss = loss.max(least);
                least = *loss * (1.0 + 1e-9);
            }
        }
        Ok(self)
    }

    /// Interpolates in the logarithms; beyond the steps the line goes on, beyond the shares it is constant.
    pub fn loss(&self, share: f64, step: f64) -> f64 {
        let logs = |values: &[f64]| values.iter().map(|value| value.ln()).collect::<Vec<f64>>();
        let (shares, steps, losses) = (logs(&self.shares), logs(&self.steps), logs(&self.loss));
        let rows: Vec<f64> = losses.chunks_exact(steps.len()).map(|row| line(&steps, row, step.ln())).collect();
        if rows.len() == 1 {
            return rows[0].exp();
        }
        line(&shares, &rows, share.ln().clamp(shares[0], shares[shares.len() - 1])).exp()
    }

    /// Returns the largest step with at most `loss_db` of expected loss.
    pub fn step_for_loss(&self, share: f64, loss_db: f64) -> f64 {
        let (mut low, mut high) = (self.steps[0] / STEP_MARGIN, self.steps[self.steps.len() - 1] * STEP_MARGIN);
        for _ in 0..SEARCH_STEPS {
            let middle = (low * high).sqrt();
            *(if self.loss(share, middle) <= loss_db { &mut low } else { &mut high }) = middle;
        }
        low
    }
}

/// Returns the piecewise linear function through `(xs, ys)` at `x`.
fn line(xs: &[f64], ys: &[f64], x: f64) -> f64 {
    let right = xs.partition_point(|known| *known <= x).clamp(1, xs.len() - 1);
    let [x0, x1, y0, y1] = [xs[right - 1], xs[right], ys[right - 1], ys[right]];
    y0 + (y1 - y0) * (x - x0) / (x1 - x0)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Half and all tokens: the loss grows with the square of the step.
    pub(crate) fn rates() -> RateTable {
        RateTable { shares: vec![0.5, 1.0], steps: vec![0.5, 1.0, 2.0], loss: vec![0.01, 0.04, 0.16, 0.02, 0.08, 0.32] }
            .checked()
            .unwrap()
    }

    #[test]
    fn steps_follow_from_losses() {
        let rates = rates();
        let near = |got: f64, expected: f64| (got / expected - 1.0).abs() < 1e-6;
        assert!(near(rates.step_for_loss(0.5, 0.04), 1.0));
        assert!(near(rates.step_for_loss(1.0, 0.005), 0.25), "the loss goes on below the finest step");
        assert!(near(rates.step_for_loss(0.01, 0.04), 1.0), "few tokens count as the fewest measured");
        assert!(near(rates.loss(0.5_f64.sqrt(), 1.0), (0.04_f64 * 0.08).sqrt()));
    }

    #[test]
    fn losses_ascend_and_other_tables_are_refused() {
        let noisy = RateTable { loss: vec![-0.01, 0.03, 0.02, 0.0, 0.0, 0.0], ..rates() }.checked().unwrap();
        assert!(noisy.loss.chunks(3).all(|loss| loss[0] > 0.0 && loss[0] < loss[1] && loss[1] < loss[2]), "{noisy:?}");
        for broken in [
            RateTable { steps: vec![1.0, 0.5, 2.0], ..rates() },
            RateTable { loss: vec![0.1; 5], ..rates() },
            RateTable { loss: vec![f64::NAN; 6], ..rates() },
            RateTable { shares: vec![0.0, 1.0], ..rates() },
        ] {
            assert!(broken.checked().is_err());
        }
    }
}
