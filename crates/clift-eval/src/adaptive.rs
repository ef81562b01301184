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
    /// Most that any rule could reach in place of the difference, in dB, had it known every PSNR of every scene: what is
    /// left to gain by choosing counts at all.
    pub difference_bound: f64,
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
        difference_bound: upper_bound(curves, count)? - mean(&fixed)?,
    })
}

/// The smallest count of a scene that leaves at most `max_error`, with its PSNR.
fn smallest(curve: &Curve, max_error: f64) -> Option<(usize, f64)> {
    curve.iter().find(|(_, error, _)| *error <= max_error).map(|(count, _, psnr)| (*count, *psnr))
}

/// Largest mean PSNR of any counts that are on average at most `count`: the linear relaxation, which takes the
/// steepest segments of all scenes' concave hulls first, the last one in part.
fn upper_bound(curves: &[Curve], count: usize) -> Option<f64> {
    let hulls: Vec<Vec<(f64, f64)>> = curves.iter().map(concave_hull).collect();
    let first: Vec<(f64, f64)> = hulls.iter().filter_map(|hull| hull.first().copied()).collect();
    let mut tokens_left: f64 = first.iter().map(|(tokens, _)| count as f64 - tokens).sum();
    let segments = hulls.iter().flat_map(|hull| hull.windows(2));
    let mut segments: Vec<(f64, f64)> = segments.map(|ends| (ends[1].0 - ends[0].0, ends[1].1 - ends[0].1)).collect();
    segments.retain(|(_, gain)| *gain > 0.0);
    segments.sort_by(|a, b| (b.1 / b.0).total_cmp(&(a.1 / a.0)));
    let mut gained = 0.0;
    for (tokens, gain) in segments {
        let share = (tokens_left / tokens).clamp(0.0, 1.0);
        gained += share * gain;
        tokens_left -= share * tokens;
    }
    Some(mean(&first.iter().map(|(_, psnr)| *psnr).collect::<Vec<_>>())? + gained / curves.len() as f64)
}

/// The corners `(count, PSNR)` of a curve's upper hull, by rising count and falling slope.
fn concave_hull(curve: &Curve) -> Vec<(f64, f64)> {
    let mut hull: Vec<(f64, f64)> = Vec::new();
    for &(count, _, psnr) in curve {
        let point = (count as f64, psnr);
        // A corner on or below the line from the one before it to the new point is none.
        while let [.., a, b] = hull[..]
            && (b.1 - a.1) * (point.0 - a.0) <= (point.1 - a.1) * (b.0 - a.0)
        {
            hull.pop();
        }
        hull.push(point);
    }
    hull
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
        // And that is the best there is: 3 dB for 12 tokens of the shelf, then 12 more for as much, none for the wall.
        assert!((adaptive.difference_bound - 1.25).abs() < 1e-12, "{adaptive:?}");
    }

    #[test]
    fn no_choice_of_counts_is_above_the_bound_and_one_is_near() {
        // PSNR that rises with noise, so that curves are not concave, and of one scene falls.
        let counts = [4_usize, 8, 16, 32];
        let psnr = |scene: usize, i: usize| ((scene * 7 + i * 5) % 11) as f64 / 4.0 + (i * (4 - scene)) as f64 - 3.0;
        let curves: Vec<Curve> =
            (0..5).map(|scene| (0..4).map(|i| (counts[i], 0.0, psnr(scene, i))).collect()).collect();
        for budget in [4, 8, 13, 16, 20, 32] {
            let mut best = f64::NEG_INFINITY;
            for choice in 0..4_usize.pow(5) {
                let of = |scene: usize| choice / 4_usize.pow(scene as u32) % 4;
                if (0..5).map(|scene| counts[of(scene)]).sum::<usize>() <= 5 * budget {
                    best = best.max((0..5).map(|scene| psnr(scene, of(scene))).sum::<f64>() / 5.0);
                }
            }
            let bound = upper_bound(&curves, budget).unwrap();
            // The relaxation cuts one segment: less than one scene's range above.
            assert!(bound >= best - 1e-12 && bound - best < 3.0, "{budget}: {best} {bound}");
            if matches!(budget, 4 | 32) {
                assert!((bound - best).abs() < 1e-12, "{budget}: {best} {bound}");
            }
        }
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
