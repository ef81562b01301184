//! The result of an evaluation in a few lines.

use std::collections::BTreeSet;
use std::fmt::Write as _;

use clift_data::plural;

use crate::config::method::Method;
use crate::statistics::summary::Summary;
use crate::statistics::view_metrics::best_method;

const MAX_COLUMNS: usize = 80;
/// Largest number of token counts, which a line holds.
const MAX_COUNTS: usize = 8;

impl Summary {
    /// Returns PSNR over stored tokens of the main method, of K-means, of random tokens and of networks without clusters, and of the baselines: at
    /// most six lines of at most 80 columns, then warnings about figures that mislead. Views are rendered from all stored
    /// tokens, in the finest number format; of many counts, those evenly spread are shown.
    pub fn headline(&self) -> String {
        let best = best_method(self.points.iter().map(|point| point.key));
        let whole = self.points.iter().filter(|point| point.key.is_whole());
        let counts: BTreeSet<usize> = whole.clone().map(|point| point.key.num_storage_tokens).collect();
        let counts: Vec<usize> = counts.into_iter().filter(|count| *count > 0).collect();
        let last = counts.len().saturating_sub(1);
        let num_shown = counts.len().min(MAX_COUNTS);
        let shown: Vec<usize> = (0..num_shown).map(|i| counts[i * last / (num_shown - 1).max(1)]).collect();
        let mut text = format!("{:<24}", "PSNR in dB, tokens");
        for count in &shown {
            let _ = write!(text, " {count:>6}");
        }
        let others = [Method::Kmeans, Method::Random].into_iter().chain(Method::whole());
        let others = others.filter(|method| Some(*method) != best);
        for method in best.into_iter().chain(others) {
            let psnr = |count: usize| {
                let of_method = whole.clone().filter(|point| point.key.method == method);
                let points = of_method.filter(|point| point.key.num_storage_tokens == count);
                points.min_by_key(|point| point.key.tokens).and_then(|point| point.quality.psnr)
            };
            if shown.iter().all(|&count| psnr(count).is_none()) {
                continue;
            }
            let _ = write!(text, "\n{:<24}", method.name());
            for &count in &shown {
                let _ = write!(text, " {:>6}", decibels(psnr(count)));
            }
        }
        let Self { num_scenes, num_views, num_skipped, split, baselines, .. } = self;
        let (views, scenes) = (plural(*num_views, "view"), plural(*num_scenes, "scene"));
        let (nearest, mean) = (decibels(baselines.nearest_view.psnr), decibels(baselines.mean_image.psnr));
        let mut line = format!("nearest_view {nearest}, mean_image {mean}; {views} of {scenes}");
        if *num_skipped > 0 {
            let _ = write!(line, ", {num_skipped} skipped");
        }
        let split = split.map_or_else(String::new, |split| format!("({split})"));
        let gap = if line.len() + split.len() < MAX_COLUMNS { " " } else { "\n" };
        let _ = write!(text, "\n{line}{gap}{split}");
        text.truncate(text.trim_end().len());
        for warning in self.warnings() {
            let _ = write!(text, "\nwarning: {warning}");
        }
        text
    }
}

fn decibels(psnr: Option<f64>) -> String {
    psnr.map_or_else(|| "-".into(), |psnr| format!("{psnr:.2}"))
}

#[cfg(test)]
mod tests {
    use clift_scene::TokenCoding;

    use super::*;
    use crate::statistics::eval_results::EvalResults;
    use crate::statistics::view_metrics::{EvalKey, ViewMetrics};

    fn results(counts: impl Iterator<Item = usize> + Clone) -> Summary {
        let mut results = EvalResults::default();
        for (method, better) in [(Method::Clift, 1.5), (Method::Kmeans, 1.0), (Method::Random, 0.0)] {
            for count in counts.clone() {
                for (tokens, loss) in [(TokenCoding::F32, 0.0), (TokenCoding::INT8, 0.5)] {
                    let tokens = Some(tokens);
                    let key = EvalKey { method, num_storage_tokens: count, num_render_tokens: count, tokens };
                    let psnr = 10.0 + better + count as f64 / 8.0 - loss;
                    results.add("a", 0, key, ViewMetrics::quality(psnr, None));
                }
            }
        }
        let nearest = EvalKey::baseline(Method::NearestView);
        results.add("a", 0, nearest, ViewMetrics::quality(12.25, None));
        results.skipped.insert("b".into());
        Summary::new(&results)
    }

    #[test]
    fn methods_have_a_line_each_in_the_finest_format() {
        let expected = "\
PSNR in dB, tokens            8     16     64
clift                     12.50  13.50  19.50
kmeans                    12.00  13.00  19.00
random                    11.00  12.00  18.00
nearest_view 12.25, mean_image -; 1 view of 1 scene, 1 skipped";
        assert_eq!(results([8, 16, 64].into_iter()).headline(), expected);
    }

    #[test]
    fn many_counts_fit_the_screen() {
        let text = results(1..=40).headline();
        assert!(text.lines().count() == 5 && text.lines().all(|line| line.len() <= 80), "{text}");
        assert!(text.starts_with("PSNR in dB, tokens            1      6     12"), "{text}");
        assert!(text.lines().next().is_some_and(|line| line.ends_with(" 40")), "{text}");
        // A single count, and a run without any point.
        assert!(results(4..=4).headline().starts_with("PSNR in dB, tokens            4\n"));
        assert_eq!(Summary::new(&EvalResults::default()).headline().lines().count(), 2);
    }
}
