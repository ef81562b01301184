//! Which of a scene's stored tokens each view is drawn from.
// S stored tokens, R rendered tokens

use std::fmt;
use std::str::FromStr;
use std::time::Instant;

use clift_data::Clip;
use clift_data::order::item_rng;
use clift_model::{ModelError, Preset, Selector, TokenRay};
use rand::seq::SliceRandom;
use serde::{Deserialize, Serialize};

use crate::EvalError;
use crate::upload::view_cameras;

/// How the tokens of a view are chosen where fewer are drawn than are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Selection {
    /// By a published set of rules.
    Preset(Preset),
    /// At random, for every view anew: what any rule must beat.
    Random,
}

impl Default for Selection {
    fn default() -> Self {
        Self::Preset(Preset::default())
    }
}

impl fmt::Display for Selection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Preset(preset) => preset.name(),
            Self::Random => "random",
        })
    }
}

impl FromStr for Selection {
    type Err = ModelError;

    fn from_str(name: &str) -> Result<Self, ModelError> {
        if name == "random" {
            return Ok(Self::Random);
        }
        let preset = Preset::ALL.into_iter().find(|preset| preset.name() == name);
        preset.map(Self::Preset).ok_or_else(|| ModelError::BadConfig {
            key: "selection",
            value: name.into(),
            fix: format!("write one of {}, random", Preset::ALL.map(Preset::name).join(", ")),
        })
    }
}

impl TryFrom<String> for Selection {
    type Error = ModelError;

    fn try_from(name: String) -> Result<Self, ModelError> {
        name.parse()
    }
}

impl From<Selection> for String {
    fn from(selection: Selection) -> Self {
        selection.to_string()
    }
}

/// The tokens of one view.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Chosen {
    /// Rows of the stored tokens, ascending.
    pub tokens: Vec<u32>,
    /// Seconds it took to choose them.
    pub select_s: f64,
}

impl Selection {
    /// Chooses the tokens of every target of a clip, in the order of its frames, which momentum needs; the result is in
    /// the order of the targets.
    ///
    /// `ids` are the patches of the context views that the stored tokens stand on, `[num_storage_tokens]`.
    pub(crate) fn choose(
        self,
        clip: &Clip,
        ids: &[u32],
        patch_size: usize,
        num_render_tokens: usize,
        seed: u64,
    ) -> Result<Vec<Chosen>, EvalError> {
        let target = &clip.target;
        let mut order: Vec<usize> = (0..target.num_views()).collect();
        order.sort_by_key(|&view| target.frame_index[view]);
        let mut choose: Box<dyn FnMut(usize) -> Result<Vec<u32>, ModelError>> = match self {
            Self::Random => Box::new(|view| Ok(random_tokens(ids.len(), num_render_tokens, seed, view))),
            Self::Preset(preset) => {
                let context = view_cameras(&clip.context);
                let rays = TokenRay::of_patches(ids, &context, clip.context.height, clip.context.width, patch_size);
                let mut selector = Selector::new(preset.rules(), &rays)?;
                let cameras = view_cameras(target);
                Box::new(move |view| selector.select(&cameras[view], target.height, target.width, num_render_tokens))
            }
        };
        let mut chosen = vec![Chosen { tokens: Vec::new(), select_s: 0.0 }; order.len()];
        for view in order {
            let started = Instant::now();
            let tokens = choose(view)?;
            chosen[view] = Chosen { tokens, select_s: started.elapsed().as_secs_f64() };
        }
        Ok(chosen)
    }
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
    use clift_data::{DVec3, Intrinsics, Pose, Views};

    use super::*;

    /// Views of 16 x 16 pixels, side by side.
    fn views(places: &[f64], frame_index: &[usize]) -> Views {
        Views {
            width: 16,
            height: 16,
            images: vec![0; places.len() * 16 * 16 * 3],
            c2w: places.iter().map(|&x| Pose { translation: x * DVec3::X, ..Pose::IDENTITY }).collect(),
            intrinsics: vec![Intrinsics { fx: 16.0, fy: 16.0, cx: 8.0, cy: 8.0 }; places.len()],
            frame_index: frame_index.to_vec(),
        }
    }

    fn clip(targets: &[f64], frame_index: &[usize]) -> Clip {
        Clip { key: "room".into(), context: views(&[-1.0, 1.0], &[0, 9]), target: views(targets, frame_index) }
    }

    fn tokens(selection: Selection, clip: &Clip, count: usize) -> Vec<Vec<u32>> {
        let chosen = selection.choose(clip, &[0, 1, 2, 3, 4, 5, 6, 7], 8, count, 5).unwrap();
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

    #[test]
    fn a_selection_is_a_name_in_files_and_on_the_command_line() {
        for name in ["paper", "global", "scaled", "random"] {
            let selection: Selection = serde_json::from_str(&format!("\"{name}\"")).unwrap();
            assert_eq!((selection.to_string(), name.parse::<Selection>().unwrap()), (name.to_owned(), selection));
            assert_eq!(serde_json::to_value(selection).unwrap(), name);
        }
        let message = "all".parse::<Selection>().unwrap_err().to_string();
        assert!(message.contains("paper, global, scaled, random"), "{message}");
    }
}
