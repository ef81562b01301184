//! Bits and loss of coded tokens, measured on renderings by token count and step when the codec is fitted.
// C counts, K steps

use clift_model::ModelError;

/// Measured rates and losses, and rules that choose count and step by them.
#[derive(Clone, Debug, PartialEq)]
pub struct RateTable {
    /// Ascending shares of all tokens, `[C]`.
    pub shares: Vec<f64>,
    /// Ascending steps, `[K]`.
    pub steps: Vec<f64>,
    /// Mean bits per token, `[C, K]`.
    pub bits: Vec<f64>,
    /// Mean loss of PSNR in dB against rendering the same tokens without rounding, positive, `[C, K]`.
    pub loss: Vec<f64>,
    /// Mean PSNR of every count without rounding in dB, `[C]`.
    pub psnr: Vec<f64>,
}

/// Smallest loss in a table, in dB: logarithms are interpolated.
const MIN_LOSS_DB: f64 = 1e-6;
/// Largest and smallest step of a search, as a factor of the measured steps.
const STEP_MARGIN: f64 = 256.0;
const SEARCH_STEPS: usize = 60;

impl RateTable {
    /// Makes losses positive and ascending with the step: means over few views can be a little off.
    ///
    /// # Errors
    /// [`ModelError::BadConfig`] for tables that are empty, unordered, of other sizes, or not finite.
    pub fn new(mut self) -> Result<Self, ModelError> {
        let (counts, steps) = (self.shares.len(), self.steps.len());
        let ascending = |values: &[f64]| values.windows(2).all(|pair| pair[0] < pair[1]);
        let sizes = [self.bits.len(), self.loss.len(), self.psnr.len()] == [counts * steps, counts * steps, counts];
        let all = [&self.shares, &self.steps, &self.bits, &self.loss, &self.psnr];
        let is_finite = all.iter().all(|values| values.iter().all(|value| value.is_finite()));
        let is_positive = self.shares.iter().chain(&self.steps).all(|value| *value > 0.0);
        if counts == 0
            || steps < 2
            || !sizes
            || !is_finite
            || !is_positive
            || !ascending(&self.shares)
            || !ascending(&self.steps)
        {
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

    /// Returns the expected loss in dB.
    pub fn loss(&self, share: f64, step: f64) -> f64 {
        let logs: Vec<f64> = self.loss.iter().map(|loss| loss.ln()).collect();
        self.at(&logs, share, step).exp()
    }

    /// Returns the expected bits per token.
    pub fn bits(&self, share: f64, step: f64) -> f64 {
        self.at(&self.bits, share, step).max(0.0)
    }

    /// Returns the largest step with at most `loss_db` of expected loss.
    pub fn step_for_loss(&self, share: f64, loss_db: f64) -> f64 {
        self.boundary(|step| self.loss(share, step) <= loss_db)[0]
    }

    /// Returns the share of tokens of the highest expected PSNR whose `num_patches` times share tokens take `bytes`.
    pub fn share_for_bytes(&self, num_patches: usize, bytes: f64) -> f64 {
        let quality = |(share, psnr): (&f64, &f64)| {
            let bits = bytes * 8.0 / (num_patches as f64 * share).max(1.0);
            let coarsest = self.steps[self.steps.len() - 1];
            if self.bits(*share, coarsest) > bits {
                return f64::NEG_INFINITY; // beyond what was measured
            }
            let [_, finest] = self.boundary(|step| self.bits(*share, step) > bits);
            psnr - self.loss(*share, finest)
        };
        let qualities: Vec<f64> = self.shares.iter().zip(&self.psnr).map(quality).collect();
        let best = (0..qualities.len()).max_by(|&a, &b| qualities[a].total_cmp(&qualities[b])).unwrap_or_default();
        if qualities[best] == f64::NEG_INFINITY { self.shares[0] } else { self.shares[best] }
    }

    /// Returns steps beyond every step that is worth a try.
    pub fn step_range(&self) -> [f64; 2] {
        [self.steps[0] / STEP_MARGIN, self.steps[self.steps.len() - 1] * STEP_MARGIN]
    }

    /// Returns steps close to each other, of which `is_low` holds for the first and not for the second.
    fn boundary(&self, is_low: impl Fn(f64) -> bool) -> [f64; 2] {
        let [mut low, mut high] = self.step_range();
        for _ in 0..SEARCH_STEPS {
            let middle = (low * high).sqrt();
            *(if is_low(middle) { &mut low } else { &mut high }) = middle;
        }
        [low, high]
    }

    /// Interpolates in the logarithms of share and step; beyond the steps the line goes on, beyond the shares it is constant.
    fn at(&self, values: &[f64], share: f64, step: f64) -> f64 {
        let steps: Vec<f64> = self.steps.iter().map(|step| step.ln()).collect();
        let rows: Vec<f64> = values.chunks_exact(steps.len()).map(|row| line(&steps, row, step.ln())).collect();
        if rows.len() == 1 {
            return rows[0];
        }
        let shares: Vec<f64> = self.shares.iter().map(|share| share.ln()).collect();
        line(&shares, &rows, share.ln().clamp(shares[0], shares[shares.len() - 1]))
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

    /// Half and all tokens: the loss grows with the square of the step, and the step takes a bit per octave.
    pub(crate) fn rates() -> RateTable {
        RateTable {
            shares: vec![0.5, 1.0],
            steps: vec![0.5, 1.0, 2.0],
            bits: vec![20.0, 10.0, 0.0, 20.0, 10.0, 0.0],
            loss: vec![0.01, 0.04, 0.16, 0.02, 0.08, 0.32],
            psnr: vec![20.0, 21.0],
        }
        .new()
        .unwrap()
    }

    #[test]
    fn steps_follow_from_losses_and_shares_from_bytes() {
        let rates = rates();
        let near = |got: f64, expected: f64| (got / expected - 1.0).abs() < 1e-6;
        assert!(near(rates.step_for_loss(0.5, 0.04), 1.0));
        assert!(near(rates.step_for_loss(1.0, 0.005), 0.25), "the loss goes on below the finest step");
        assert!(near(rates.step_for_loss(0.01, 0.04), 1.0), "few tokens count as the fewest measured");
        assert!(near(rates.loss(0.5_f64.sqrt(), 1.0), (0.04_f64 * 0.08).sqrt()));
        assert!(near(rates.bits(1.0, 2_f64.sqrt()), 5.0) && rates.bits(1.0, 9.0) == 0.0);
        assert_eq!(rates.share_for_bytes(80, 100.0), 1.0, "80 tokens of 10 bits lose 0.08 dB, half of them 1 dB");
        let few = RateTable { psnr: vec![21.0, 20.0], ..rates.clone() };
        assert_eq!(few.share_for_bytes(80, 100.0), 0.5);
    }

    #[test]
    fn losses_ascend_and_other_tables_are_refused() {
        let noisy = RateTable { loss: vec![-0.01, 0.03, 0.02, 0.0, 0.0, 0.0], ..rates() }.new().unwrap();
        assert!(noisy.loss.chunks(3).all(|loss| loss[0] > 0.0 && loss[0] < loss[1] && loss[1] < loss[2]), "{noisy:?}");
        for broken in [
            RateTable { steps: vec![1.0, 0.5, 2.0], ..rates() },
            RateTable { psnr: vec![20.0], ..rates() },
            RateTable { bits: vec![f64::NAN; 6], ..rates() },
            RateTable { shares: vec![0.0, 1.0], ..rates() },
        ] {
            assert!(broken.new().is_err());
        }
    }
}
