//! Tokens selected for each target view of a scene.
// S stored tokens, R rendered tokens

use std::time::Instant;

use clift_data::{Clip, item_rng};
use clift_model::{ModelError, Selector, TokenRay};
use rand::seq::SliceRandom;

use crate::config::token_selection::Selection;
use crate::error::EvalError;
use crate::upload::view_cameras;

/// The tokens of one view.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct SelectedTokens {
    /// Rows of the stored tokens, ascending.
    pub tokens: Vec<u32>,
    /// Seconds of the selection.
    pub select_s: f64,
}

/// Selects the tokens of every target of a clip, in the order of its frames, which momentum needs; the result is in
/// the order of the targets.
///
/// `ids` are the patches of the context views that the stored tokens stand on, `[num_storage_tokens]`.
pub(crate) fn choose(
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
    let mut choose: Box<dyn FnMut(usize) -> Result<Vec<u32>, ModelError>> = match selection {
        Selection::Random => Box::new(|view| Ok(random_tokens(ids.len(), num_render_tokens, seed, view))),
        Selection::Preset(preset) => {
            let context = view_cameras(&clip.context);
            let rays = TokenRay::of_patches(ids, &context, clip.context.height, clip.context.width, patch_size);
            let mut selector = Selector::new(preset.rules(), &rays)?;
            let cameras = view_cameras(target);
            Box::new(move |view| selector.select(&cameras[view], target.height, target.width, num_render_tokens))
        }
    };
    let mut chosen = vec![SelectedTokens { tokens: Vec::new(), select_s: 0.0 }; order.len()];
    for view in order {
        let started = Instant::now();
        let tokens = choose(view)?;
        chosen[view] = SelectedTokens { tokens, select_s: started.elapsed().as_secs_f64() };
    }
    Ok(chosen)
}

/// `count` of `num_tokens` without replacement, ascending.
fn random_tokens(num_tokens: usize, count: usize, seed: u64, view: usize) -> Vec<u32> {
    let mut tokens: Vec<u32> = (0..num_tokens as u32).collect();
    tokens.shuffle(&mut item_rng(seed, view as u64, 0, 0, "random selection"));
    tokens.truncate(count);
    tokens.sort_unstable();
    tokens
}

#[cfg(test)]
mod tests {
    use clift_data::{ClipViews, Intrinsics, Pose};

    use super::*;

    /// Views of 16 x 16 pixels, side by side.
    fn views(places: &[f64], frame_index: &[usize]) -> ClipViews {
        ClipViews {
            width: 16,
            height: 16,
            images: vec![0; places.len() * 16 * 16 * 3],
            c2w: places.iter().map(|&x| Pose { translation: [x, 0.0, 0.0].into(), ..Pose::IDENTITY }).collect(),
            intrinsics: vec![Intrinsics { fx: 16.0, fy: 16.0, cx: 8.0, cy: 8.0 }; places.len()],
            frame_index: frame_index.to_vec(),
        }
    }

    fn clip(targets: &[f64], frame_index: &[usize]) -> Clip {
        Clip { key: "room".into(), context: views(&[-1.0, 1.0], &[0, 9]), target: views(targets, frame_index) }
    }

    fn tokens(selection: Selection, clip: &Clip, count: usize) -> Vec<Vec<u32>> {
        let chosen = choose(selection, clip, &[0, 1, 2, 3, 4, 5, 6, 7], 8, count, 5).unwrap();
        chosen.into_iter().map(|chosen| chosen.tokens).collect()
    }

    #[test]
    fn momentum_follows_the_frames_and_not_the_order_of_the_list() {
        let places = [-1.0, -0.3, 0.4, 1.0];
        let listed = tokens(Selection::default(), &clip(&places, &[1, 2, 3, 4]), 3);
        let mut reversed_places = places;
        reversed_places.reverse();
        let mut reversed = tokens(Selection::default(), &clip(&reversed_places, &[4, 3, 2, 1]), 3);
        reversed.reverse();
        assert_eq!(reversed, listed);
        assert!(listed.iter().all(|tokens| tokens.len() == 3));
    }

    #[test]
    fn random_tokens_are_distinct_and_of_seed_and_view() {
        let drawn = tokens(Selection::Random, &clip(&[0.0; 20], &(0..20).collect::<Vec<_>>()), 4);
        assert!(drawn.iter().all(|tokens| tokens.len() == 4 && tokens.windows(2).all(|pair| pair[0] < pair[1])));
        assert!(drawn.iter().any(|tokens| *tokens != drawn[0]), "every view anew");
        assert_eq!(random_tokens(8, 4, 5, 3), drawn[3]);
        assert!((0..20).any(|view| random_tokens(8, 4, 6, view) != drawn[view]));
    }
}
