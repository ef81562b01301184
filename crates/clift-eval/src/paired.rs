//! Which variant is better, scene by scene.
//!
//! Scenes differ far more than variants do: the standard error of a difference is that of the differences of the same
//! scenes, not that of two means.

use std::collections::BTreeMap;

use clift_model::TokenStorage;
use serde::{Deserialize, Serialize};

use crate::measured::{Accumulator, Setting, Variant, ViewsOfSetting};
use crate::summary::{capped, mean, standard_error};

/// What the paper says is better than what (section 4.3): the better one first.
const ORDERINGS: [[Variant; 2]; 5] = [
    [Variant::Kmeans, Variant::Random],
    [Variant::Clift, Variant::Kmeans],
    [Variant::Kmeans, Variant::Patch],
    [Variant::PatchClift, Variant::Patch],
    [Variant::Clift, Variant::PatchClift],
];

/// Mean difference of the PSNR of the same scenes in two variants, all stored tokens rendered.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Difference {
    /// The variant that the paper finds better.
    pub variant: Variant,
    /// The one it is compared with.
    pub against: Variant,
    /// Tokens in the scene file, of both.
    pub num_storage_tokens: usize,
    /// Number format of the stored tokens, of both; random subsets are never rounded.
    pub tokens: Option<TokenStorage>,
    /// Scenes that were measured in both.
    pub num_scenes: usize,
    /// Mean over those scenes of `variant` less `against`, in dB: positive where the paper's order holds.
    pub psnr: f64,
    /// Standard error of that mean; `null` for a single scene.
    pub psnr_stderr: Option<f64>,
}

impl Accumulator {
    /// Every ordering that both sides were measured for, by ordering and rising token count.
    pub fn differences(&self) -> Vec<Difference> {
        let mut differences = Vec::new();
        for [variant, against] in ORDERINGS {
            for (setting, better) in &self.views {
                let count = setting.num_storage_tokens;
                if setting.variant != variant || setting.num_render_tokens != count {
                    continue;
                }
                let tokens = if against == Variant::Random { Some(TokenStorage::F32) } else { setting.tokens };
                if let Some(other) = self.views.get(&Setting { variant: against, tokens, ..*setting }) {
                    let per_scene = paired(better, other);
                    differences.extend(mean(&per_scene).map(|psnr| Difference {
                        variant,
                        against,
                        num_storage_tokens: count,
                        tokens: setting.tokens,
                        num_scenes: per_scene.len(),
                        psnr,
                        psnr_stderr: standard_error(&per_scene),
                    }));
                }
            }
        }
        differences
    }
}

/// Mean difference of every scene, over the views that both sides have.
fn paired(better: &ViewsOfSetting, other: &ViewsOfSetting) -> Vec<f64> {
    let mut scenes: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
    for (view, measured) in better {
        if let Some(against) = other.get(view) {
            scenes.entry(&view.0).or_default().push(capped(measured.psnr) - capped(against.psnr));
        }
    }
    scenes.values().filter_map(|differences| mean(differences)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measured::Measured;

    fn setting(variant: Variant, num_storage_tokens: usize, num_render_tokens: usize) -> Setting {
        Setting { variant, num_storage_tokens, num_render_tokens, tokens: Some(TokenStorage::F32) }
    }

    fn accumulator(rows: &[(&str, usize, Setting, f64)]) -> Accumulator {
        let mut views = Accumulator::default();
        for &(scene, frame, setting, psnr) in rows {
            views.add(scene, frame, setting, Measured::quality(psnr, None)).unwrap();
        }
        views
    }

    #[test]
    fn scenes_are_paired_and_views_averaged_within_them() {
        let (better, worse) = (setting(Variant::Kmeans, 8, 8), setting(Variant::Random, 8, 8));
        let views = accumulator(&[
            ("attic", 1, better, 21.0),
            ("attic", 2, better, 24.0),
            ("attic", 1, worse, 20.0),
            ("attic", 2, worse, 21.0),
            ("cellar", 1, better, 10.0),
            ("cellar", 1, worse, 11.0),
            // Measured on one side alone.
            ("hall", 1, better, 30.0),
        ]);
        let [difference] = &views.differences()[..] else { panic!("one ordering at one count") };
        // 2 dB in the attic, -1 dB in the cellar.
        assert_eq!((difference.variant, difference.against), (Variant::Kmeans, Variant::Random));
        assert_eq!((difference.num_scenes, difference.psnr, difference.psnr_stderr), (2, 0.5, Some(1.5)));
    }

    #[test]
    fn counts_are_compared_with_the_same_count_and_only_where_all_tokens_are_rendered() {
        let views = accumulator(&[
            ("attic", 1, setting(Variant::Clift, 8, 8), 20.0),
            ("attic", 1, setting(Variant::Clift, 8, 4), 19.0),
            ("attic", 1, setting(Variant::Kmeans, 8, 4), 18.0),
            ("attic", 1, setting(Variant::Kmeans, 16, 16), 22.0),
            ("attic", 1, setting(Variant::Clift, 16, 16), f64::INFINITY),
        ]);
        let [difference] = &views.differences()[..] else { panic!("one ordering at one count") };
        assert_eq!((difference.num_storage_tokens, difference.psnr), (16, 100.0 - 22.0));
        assert_eq!(difference.psnr_stderr, None, "of a single scene");
    }
}
