//! The distribution over scenes, with the worst and the best ones.

use maud::{Markup, html};

use crate::report::html::{number, table};
use crate::report::plot::{Look, Mark, Plot, Series};
use crate::statistics::scene_scores::{SceneScore, SceneScores};
use crate::sweep::rendered_views::spread;

/// Number of the worst scenes in the table, and of the best.
const MAX_LISTED: usize = 5;
/// Largest number of scenes in the plot.
const MAX_MARKS: usize = 200;
/// Largest number of characters of a key.
const MAX_KEY_CHARS: usize = 48;

const HEAD: [&str; 5] = ["rank", "scene", "PSNR\ndB", "nearest\nview, dB", "difference\ndB"];

/// Returns the plot and the table; nothing for fewer than two scenes.
pub fn section(scores: &SceneScores) -> Markup {
    let (Some(key), 2..) = (scores.key, scores.scenes.len()) else { return Markup::default() };
    let count = scores.scenes.len();
    let listed = (0..count).filter(|rank| *rank < MAX_LISTED || rank + MAX_LISTED >= count);
    let rows = html! {
        @for rank in listed {
            @let SceneScore { scene, psnr, nearest_psnr } = &scores.scenes[rank];
            tr.first[rank == count.saturating_sub(MAX_LISTED) && rank > MAX_LISTED] {
                td { (rank + 1) }
                td { (shortened(scene)) }
                td { (number(Some(*psnr), 2)) }
                td { (number(*nearest_psnr, 2)) }
                td { (number(nearest_psnr.map(|nearest| psnr - nearest), 2)) }
            }
        }
    };
    html! {
        h2 { "Scene by scene" }
        p.note {
            (key.method.name()) " with " (key.num_storage_tokens) " stored tokens: mean PSNR of the views of each scene, from "
            "the worst to the best; " code { "scenes.csv" } " has all."
        }
        div.figures {
            section { (plot(&scores.scenes).to_html()) }
            section { (table(None, &HEAD, &rows)) }
        }
    }
}

fn shortened(key: &str) -> String {
    if key.chars().count() <= MAX_KEY_CHARS {
        return key.into();
    }
    key.chars().take(MAX_KEY_CHARS).chain(['\u{2026}']).collect()
}

fn plot(scenes: &[SceneScore]) -> Plot {
    let series = |name: &str, look: Look, is_joined: bool, value: fn(&SceneScore) -> Option<f64>| {
        let ranks = spread(scenes.len(), MAX_MARKS).into_iter();
        let marks = ranks.filter_map(|rank| {
            let (y, x) = (value(&scenes[rank])?, (rank + 1) as f64);
            Some(Mark { x, y, error: None, title: format!("{}: {name}, {y:.2} dB", shortened(&scenes[rank].scene)) })
        });
        Series { name: name.into(), look, is_joined, marks: marks.collect() }
    };
    Plot {
        title: "PSNR of every scene, from the worst to the best".into(),
        x_label: "scenes, from worst to best",
        series: vec![
            series("rendered", Look::ALL[0], true, |score| Some(score.psnr)),
            series("nearest view", Look::ALL[2], false, |score| score.nearest_psnr),
        ],
        ..Plot::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::method::Method;
    use crate::testing::f32_key;

    #[test]
    fn worst_and_best_scenes_are_listed() {
        let score = |rank: u32| SceneScore {
            scene: format!("room-{rank}-{}", "x".repeat(5000)),
            psnr: f64::from(rank),
            nearest_psnr: Some(1.5),
        };
        let scores =
            |count| SceneScores { key: Some(f32_key(Method::Clift, 8, 8)), scenes: (0..count).map(score).collect() };
        let table = section(&scores(40)).into_string();
        let table = table.split("<tbody>").nth(1).unwrap();
        let ranks = [0, 4, 5, 34, 35, 39].map(|rank| table.contains(&format!("room-{rank}-")));
        assert_eq!(ranks, [true, true, false, false, true, true]);
        assert!(table.contains('\u{2026}') && table.len() < 4000, "long keys are cut");
        assert_eq!(section(&scores(1)).into_string(), "");
    }
}
