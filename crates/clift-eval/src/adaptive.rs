//! Does a count chosen for every scene beat one count for all?
//!
//! `clift encode --max-error` keeps the fewest tokens that leave at most a share of the tokens' variance within
//! clusters. Here that share is set so that the scenes keep on average no more tokens than a fixed count, and the same
//! scenes are compared.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use crate::measured::{Accumulator, Setting, Variant};
use crate::summary::{mean, scene_values, standard_error};

/// A count for every scene against one for all, at no more tokens on average.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Adaptive {
    /// What is stored, `clift` or `kmeans`.
    pub variant: Variant,
    /// Most of the tokens' variance that may stay within clusters, as a share.
    pub max_error: f64,
    /// Tokens that scenes keep on average with it.
    pub mean_storage_tokens: f64,
    /// The fixed count it is compared with: at least as many.
    pub num_storage_tokens: usize,
    /// Scenes.
    pub num_scenes: usize,
    /// Mean over scenes of the scene's mean PSNR with a count of its own, in dB.
    pub psnr: f64,
    /// Mean over scenes of that less the PSNR with the fixed count, in dB: positive where adapting pays.
    pub difference: f64,
    /// Standard error of the difference; `null` for a single scene.
    pub difference_stderr: Option<f64>,
}

/// What one scene leaves within clusters and reaches, by rising count.
type Curve = Vec<(usize, f64, f64)>;

impl Accumulator {
    /// Notes the share of a scene's token variance that so many clusters leave within them.
    pub fn add_cluster_error(&mut self, scene: &str, num_storage_tokens: usize, error: f64) {
        self.cluster_errors.insert((scene.to_owned(), num_storage_tokens), error);
    }

    /// One comparison per count but the smallest, where a scene could keep fewer than which, and the largest.
    pub fn adaptive(&self) -> Vec<Adaptive> {
        let variants = [Variant::Clift, Variant::Kmeans];
        let Some(variant) = variants.into_iter().find(|v| self.views.keys().any(|s| s.variant == *v)) else {
            return Vec::new();
        };
        let curves = self.curves(variant);
        let counts: BTreeSet<usize> = curves.iter().flatten().map(|(count, ..)| *count).collect();
        let inner: Vec<usize> = counts.iter().copied().skip(1).take(counts.len().saturating_sub(2)).collect();
        inner.into_iter().filter_map(|count| compare(&curves, variant, count)).collect()
    }

    /// Scenes that were measured at every count.
    fn curves(&self, variant: Variant) -> Vec<Curve> {
        let mut curves: BTreeMap<&str, Curve> = BTreeMap::new();
        let whole = |setting: &Setting| setting.num_render_tokens == setting.num_storage_tokens;
        let settings = self.views.iter().filter(|(setting, _)| setting.variant == variant && whole(setting));
        // Of the finest format, where there are several.
        let format = settings.clone().map(|(setting, _)| setting.tokens).min().flatten();
        let settings = settings.filter(|(setting, _)| setting.tokens == format);
        let mut num_counts = 0;
        for (setting, views) in settings {
            num_counts += 1;
            let count = setting.num_storage_tokens;
            for (scene, psnr) in scene_values(views) {
                if let Some(&error) = self.cluster_errors.get(&(scene.to_owned(), count)) {
                    curves.entry(scene).or_default().push((count, error, psnr));
                }
            }
        }
        curves.into_values().filter(|curve| curve.len() == num_counts).collect()
    }
}

/// Adapts to the fixed `count`; nothing where every scene keeps that count or no share serves.
fn compare(curves: &[Curve], variant: Variant, count: usize) -> Option<Adaptive> {
    // The errors that occur are the only shares at which anything changes.
    let mut shares: Vec<f64> = curves.iter().flatten().map(|(_, error, _)| *error).collect();
    shares.sort_by(f64::total_cmp);
    let kept = |max_error: f64| curves.iter().map(move |curve| smallest(curve, max_error)).collect::<Option<Vec<_>>>();
    let tokens = |kept: &[(usize, f64)]| mean(&kept.iter().map(|(count, _)| *count as f64).collect::<Vec<_>>());
    // A larger share keeps fewer tokens: the smallest that is cheap enough.
    let first = shares
        .partition_point(|&share| kept(share).as_deref().and_then(tokens).is_none_or(|tokens| tokens > count as f64));
    let max_error = *shares.get(first)?;
    let kept = kept(max_error)?;
    let fixed = curves.iter().map(|curve| curve.iter().find(|point| point.0 == count).map(|point| point.2));
    let fixed: Vec<f64> = fixed.collect::<Option<_>>()?;
    let differences: Vec<f64> = kept.iter().zip(&fixed).map(|((_, psnr), fixed)| psnr - fixed).collect();
    Some(Adaptive {
        variant,
        max_error,
        mean_storage_tokens: tokens(&kept)?,
        num_storage_tokens: count,
        num_scenes: curves.len(),
        psnr: mean(&kept.iter().map(|(_, psnr)| *psnr).collect::<Vec<_>>())?,
        difference: mean(&differences)?,
        difference_stderr: standard_error(&differences),
    })
}

/// The smallest count of a scene that leaves at most `max_error`, with its PSNR.
fn smallest(curve: &Curve, max_error: f64) -> Option<(usize, f64)> {
    curve.iter().find(|(_, error, _)| *error <= max_error).map(|(count, _, psnr)| (*count, *psnr))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measured::Measured;

    const SETTING: Setting = Setting::baseline(Variant::Clift);

    /// (count, error, PSNR)
    type Points<'a> = &'a [(usize, f64, f64)];

    fn accumulator(scenes: &[(&str, Points)]) -> Accumulator {
        let mut views = Accumulator::default();
        for (scene, points) in scenes {
            for &(count, error, psnr) in *points {
                let whole = Setting { num_storage_tokens: count, num_render_tokens: count, ..SETTING };
                views.add(scene, 1, whole, Measured::quality(psnr, None)).unwrap();
                views.add_cluster_error(scene, count, error);
            }
        }
        views
    }

    #[test]
    fn a_plain_scene_gives_its_tokens_to_a_rich_one() {
        // The wall gains nothing from tokens, the shelf much: 8 and 32 cost as much as 20 and 20.
        let wall = [(8, 0.05, 30.0), (20, 0.04, 30.5), (32, 0.0, 31.0)];
        let shelf = [(8, 0.5, 20.0), (20, 0.2, 23.0), (32, 0.05, 26.0)];
        let views = accumulator(&[("wall", &wall), ("shelf", &shelf)]);
        let [adaptive] = &views.adaptive()[..] else { panic!("the inner count alone") };
        assert_eq!((adaptive.num_storage_tokens, adaptive.mean_storage_tokens), (20, 20.0));
        assert_eq!((adaptive.max_error, adaptive.psnr, adaptive.num_scenes), (0.05, 28.0, 2));
        // -0.5 dB at the wall, +3 dB at the shelf.
        assert_eq!((adaptive.difference, adaptive.difference_stderr), (1.25, Some(1.75)));
    }

    #[test]
    fn it_never_costs_more_than_the_fixed_count_and_may_lose() {
        // Errors that say the opposite of what pays.
        let wall = [(8, 0.5, 30.0), (20, 0.3, 30.5), (32, 0.1, 30.6)];
        let shelf = [(8, 0.2, 20.0), (20, 0.1, 23.0), (32, 0.05, 26.0)];
        let views = accumulator(&[("wall", &wall), ("shelf", &shelf)]);
        let [adaptive] = &views.adaptive()[..] else { panic!("the inner count alone") };
        // At 0.1 the scenes keep 32 and 20 tokens, at 0.2 32 and 8.
        assert_eq!((adaptive.max_error, adaptive.mean_storage_tokens), (0.2, 20.0));
        assert!((adaptive.difference - (0.1 - 3.0) / 2.0).abs() < 1e-12, "{adaptive:?}");
    }

    #[test]
    fn scenes_without_every_count_are_left_out_and_nothing_is_compared_without_errors() {
        let whole = [(8, 0.5, 20.0), (20, 0.2, 23.0), (32, 0.05, 26.0)];
        let views = accumulator(&[("attic", &whole), ("cellar", &whole[..2])]);
        assert_eq!(views.adaptive()[0].num_scenes, 1);
        let mut views = accumulator(&[("attic", &whole)]);
        views.cluster_errors.clear();
        assert_eq!(views.adaptive(), []);
        assert_eq!(Accumulator::default().adaptive(), []);
    }
}
