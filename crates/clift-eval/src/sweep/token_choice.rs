//! Tokens selected for each target view of a scene.
// S stored tokens, R rendered tokens

use std::time::Instant;

use clift_core::{ClipViews, item_rng};
use clift_data::Clip;
use clift_model::{ModelError, Selector, TokenRay};

use crate::config::token_selection::Selection;
use crate::error::EvalError;
use crate::sweep::compressed_tokens::random_subset;

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct SelectedTokens {
    /// Rows of the stored tokens, ascending.
    pub tokens: Vec<u32>,
    pub select_s: f64,
}

/// Selects in the order of frames, which momentum (Algorithm 1) needs, and returns the order of the target views.
///
/// `ids` are the patches of the stored tokens in the context views, `[S]`.
pub(crate) fn select_for_views(
    selection: Selection,
    clip: &Clip,
    ids: &[u32],
    patch_size: usize,
    num_render_tokens: usize,
    seed: u64,
) -> Result<Vec<SelectedTokens>, EvalError> {
    let target = &clip.target;
    let mut order: Vec<usize> = (0..target.num_views()).collect();
    order.sort_by_key(|&view| target.frame_index[view]);
    let mut select: Box<dyn FnMut(usize) -> Result<Vec<u32>, ModelError>> = match selection.preset() {
        None => Box::new(|view| {
            let rng = item_rng(seed, view as u64, 0, 0, "random selection");
            Ok(random_subset(ids.len(), num_render_tokens, rng))
        }),
        Some(preset) => {
            let ClipViews { cameras, height, width, .. } = &clip.context;
            let rays = TokenRay::of_patches(ids, cameras, *height, *width, patch_size);
            let mut selector = Selector::new(preset.rules(), &rays)?;
            Box::new(move |view| selector.select(&target.cameras[view], target.height, target.width, num_render_tokens))
        }
    };
    let mut selected = vec![SelectedTokens { tokens: Vec::new(), select_s: 0.0 }; order.len()];
    for view in order {
        let started = Instant::now();
        let tokens = select(view)?;
        selected[view] = SelectedTokens { tokens, select_s: started.elapsed().as_secs_f64() };
    }
    Ok(selected)
}

#[cfg(test)]
mod tests {
    use clift_core::Pose;

    use super::*;
    use crate::testing::gray_views;

    /// Views of 16 x 16 pixels, side by side.
    fn views(x: &[f64], frames: &[usize]) -> ClipViews {
        let poses = x.iter().map(|&x| Pose { translation: [x, 0.0, 0.0].into(), ..Pose::IDENTITY });
        gray_views((16, 16), 0, poses.collect(), frames.to_vec())
    }

    fn clip(targets: &[f64], frame_index: &[usize]) -> Clip {
        Clip {
            key: "room".into(),
            context: views(&[-1.0, 1.0], &[0, 9]),
            target: views(targets, frame_index),
            target_weights: None,
        }
    }

    fn tokens(selection: Selection, clip: &Clip, count: usize) -> Vec<Vec<u32>> {
        let selected = select_for_views(selection, clip, &[0, 1, 2, 3, 4, 5, 6, 7], 8, count, 5).unwrap();
        selected.into_iter().map(|selected| selected.tokens).collect()
    }

    #[test]
    fn momentum_follows_the_order_of_frames() {
        let places = [-1.0, -0.3, 0.4, 1.0];
        let listed = tokens(Selection::default(), &clip(&places, &[1, 2, 3, 4]), 3);
        let mut reversed = tokens(Selection::default(), &clip(&[1.0, 0.4, -0.3, -1.0], &[4, 3, 2, 1]), 3);
        reversed.reverse();
        assert_eq!(reversed, listed);
        assert!(listed.iter().all(|tokens| tokens.len() == 3));
    }

    #[test]
    fn random_tokens_differ_between_views() {
        let sampled = tokens(Selection::Random, &clip(&[0.0; 20], &(0..20).collect::<Vec<_>>()), 4);
        assert!(sampled.iter().all(|tokens| tokens.len() == 4 && tokens.windows(2).all(|pair| pair[0] < pair[1])));
        assert!(sampled.iter().any(|tokens| *tokens != sampled[0]));
        let subset = |count| random_subset(8, count, item_rng(5, 3, 0, 0, "random selection"));
        assert_eq!(subset(4), sampled[3]);
        assert!(subset(4).iter().all(|token| subset(6).contains(token)), "subsets are nested");
    }
}
