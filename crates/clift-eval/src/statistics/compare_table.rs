//! The terminal table of a comparison.

use std::fmt;

use crate::statistics::compare::{Comparison, PairedRow};
use crate::statistics::metric_difference::MetricDifference;
use crate::statistics::text_table::table;

impl fmt::Display for Comparison {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "A: {}\nB: {}\n", self.a.display(), self.b.display())?;
        let metrics = ["dB", "SSIM", "LPIPS", "sharpness"].map(|metric| format!("B - A, {metric} (95 %)"));
        let header = ["method", "scenes", "PSNR of A", &metrics[0], &metrics[1], &metrics[2], &metrics[3]];
        writeln!(f, "{}", table(header, self.pairs.iter().map(cells)))?;
        writeln!(
            f,
            "\nMeans of paired differences over scenes, with 95 % intervals of Student's t; *: the interval excludes zero. Lower \
             LPIPS is better."
        )?;
        let largest = |count: fn(&PairedRow) -> usize| self.pairs.iter().map(count).max().unwrap_or_default();
        let (only_a, only_b) = (largest(|pair| pair.num_only_a), largest(|pair| pair.num_only_b));
        if only_a + only_b > 0 {
            let common = self.pairs.iter().map(|pair| pair.num_views).max().unwrap_or_default();
            writeln!(
                f,
                "The evaluations have different target views: {common} common views are compared, up to {only_a} views of A \
                 and {only_b} views of B are ignored."
            )?;
        }
        for (side, keys) in [("A", &self.only_a), ("B", &self.only_b)] {
            if !keys.is_empty() {
                let keys = keys.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
                writeln!(f, "Only in {side}, not compared: {keys}.")?;
            }
        }
        if !self.only_a.is_empty() && !self.only_b.is_empty() {
            writeln!(f, "Other formats or methods are compared with `--methods A,B`, such as clift:f32,clift:f16.")?;
        }
        Ok(())
    }
}

fn cells(pair: &PairedRow) -> [String; 7] {
    [
        if pair.a == pair.b { pair.a.to_string() } else { format!("{} -> {}", pair.a, pair.b) },
        pair.num_scenes.to_string(),
        pair.psnr.map_or_else(|| "-".into(), |difference| format!("{:.2}", difference.a)),
        interval(pair.psnr, 3),
        interval(pair.ssim, 4),
        interval(pair.lpips_vgg, 4),
        interval(pair.sharpness, 3),
    ]
}

fn interval(difference: Option<MetricDifference>, decimals: usize) -> String {
    let Some(difference) = difference else { return "-".into() };
    let mark = if difference.is_clear() { " *" } else { "" };
    match difference.interval {
        Some([low, high]) => {
            format!("{:+.decimals$} [{low:+.decimals$}, {high:+.decimals$}]{mark}", difference.mean)
        }
        None => format!("{:+.decimals$}", difference.mean),
    }
}
