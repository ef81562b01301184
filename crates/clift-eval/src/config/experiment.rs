//! The experiments of the paper as evaluation settings.

use clift_model::TokenCount;
use strum::{IntoStaticStr, VariantArray};

use crate::config::eval_config::EvalConfig;
use crate::config::method::Method;
use crate::config::token_selection::Selection;

/// An experiment of the paper.
#[derive(Clone, Copy, Debug, PartialEq, Eq, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "lowercase")]
pub enum Experiment {
    /// Quality against data size (section 4.2).
    Main,
    /// Random tokens, K-means, K-means and condenser (section 4.3, "`CLiFT` Construction").
    Ablation,
    /// Tiles of the views against K-means, each with and without condenser (section 4.3).
    Patchwise,
    /// Quality and cost against rendered tokens, half of all stored (section 4.3, "`CLiFT` Rendering").
    Budget,
}

impl Experiment {
    /// Sets methods, token counts and selection. Scenes and views stay.
    ///
    /// Counts are shares, valid for other numbers of tokens than the paper's 4,096. The patch-wise table has 256 and 1,024
    /// of 4,096 tokens; the table of render budgets stores 4,096 of 8,192 tokens and renders 4,096 to 512.
    pub fn apply(self, eval: &mut EvalConfig) {
        let (stored, render, methods): (&[f64], &[f64], &[Method]) = match self {
            Self::Main => (&[1.0 / 16.0, 0.125, 0.25, 0.5, 0.75, 1.0], &[], &[Method::Clift]),
            Self::Ablation => {
                (&[1.0 / 32.0, 1.0 / 16.0, 0.125, 0.25, 0.5], &[], &[Method::Random, Method::Kmeans, Method::Clift])
            }
            Self::Patchwise => {
                (&[1.0 / 16.0, 0.125, 0.25], &[], &[Method::Tile, Method::TileClift, Method::Kmeans, Method::Clift])
            }
            Self::Budget => (&[0.5], &[0.75, 0.5, 0.25, 0.125], &[Method::Clift]),
        };
        let shares = |shares: &[f64]| shares.iter().map(|&share| TokenCount::Share(share)).collect();
        (eval.stored_tokens, eval.render, eval.methods) = (shares(stored), shares(render), methods.into());
        if self == Self::Main {
            // The size axis: plain numbers, and the codec at two losses.
            eval.formats = ["f16", "coded", "coded-0.1"].map(|name| name.parse().expect("a format")).into();
        }
        if self == Self::Budget {
            // As in the published table: no momentum, no count per cell.
            eval.selection = Selection::Global;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_equal_the_paper() {
        let counts = |experiment: Experiment, num_tokens: usize| {
            let mut eval = EvalConfig::default();
            experiment.apply(&mut eval);
            let of = |counts: &[TokenCount], total| counts.iter().map(|c| c.of(total).unwrap()).collect::<Vec<_>>();
            let stored = of(&eval.stored_tokens, num_tokens);
            let render = of(&eval.render, stored[0]);
            (stored, render)
        };
        assert_eq!(counts(Experiment::Main, 4096).0, [256, 512, 1024, 2048, 3072, 4096]);
        assert_eq!(counts(Experiment::Ablation, 4096).0, [128, 256, 512, 1024, 2048]);
        assert_eq!(counts(Experiment::Patchwise, 4096).0, [256, 512, 1024]);
        assert_eq!(counts(Experiment::Budget, 8192), (vec![4096], vec![3072, 2048, 1024, 512]));
    }
}
