use clift_model::SceneClusters;
use clift_scene::TokenCoding;

use super::*;
use crate::config::method::{Method, MethodName};
use crate::figures::canvas::Canvas;
use crate::figures::scene_figure::{FigureImage, FigureTokens};
use crate::statistics::eval_results::EvalResults;
use crate::statistics::view_metrics::{EvalKey, ViewMetrics};
use crate::testing::f32_key as key;

const HOSTILE: &str = "<script>alert('room')</script>";

/// Two methods at two counts and one selection, over two scenes.
fn summary() -> Summary {
    let mut results = EvalResults::default();
    for (scene, shift) in [("a", 0.0), ("b", 1.0)] {
        let nearest = ViewMetrics::quality(15.0 + shift, Some(0.4));
        results.add(scene, 3, EvalKey::baseline(Method::NearestView), nearest);
        for (method, stored, rendered, psnr, ms) in [
            (Method::Clift, 4, 4, 16.0, 2.0),
            (Method::Clift, 8, 8, 18.0, 3.0),
            (Method::Clift, 8, 2, 14.5, 1.0),
            (Method::Random, 4, 4, 14.0, 2.5),
        ] {
            let key = key(method, stored, rendered);
            let metrics = ViewMetrics::quality(psnr + shift, Some(psnr / 40.0));
            results.add(scene, 3, key, ViewMetrics { render_s: Some(ms * 1e-3), ..metrics });
            if method == Method::Clift {
                results.add_scene_bytes(key, 1000 * stored as u64);
            }
        }
    }
    Summary::new(&results)
}

/// A scene of two views of 2 x 2 patches.
fn figure() -> SceneFigure {
    let image = |level| Canvas::new(16, 16, [level; 3]);
    let rendering = |key| FigureImage { key, psnr: 17.25, image: image(90), error: Some(image(200)) };
    SceneFigure {
        scene: HOSTILE.into(),
        grid: [2, 2],
        context: vec![image(10), image(20)],
        context_frames: vec![0, 7],
        target: image(50),
        target_frame: 3,
        images: vec![
            rendering(EvalKey::baseline(Method::NearestView)),
            rendering(key(Method::Clift, 4, 4)),
            rendering(key(Method::Clift, 8, 2)),
            rendering(key(Method::Clift, 8, 8)),
        ],
        clusters: vec![
            SceneClusters::new(vec![0, 0, 1, 1, 2, 2, 3, 3], vec![1, 2, 4, 7]).unwrap(),
            SceneClusters::identity(8),
        ],
        selections: vec![FigureTokens {
            key: key(Method::Clift, 8, 2),
            stored: (0..8).collect(),
            selected: vec![1, 6],
        }],
    }
}

fn report() -> Report {
    let mut skipped = SkipReport::new(3);
    skipped.skip("c", format!("bad frame {HOSTILE}"));
    Report {
        run: RunDescription {
            name: format!("run {HOSTILE}"),
            config: format!("data.root = \"{HOSTILE}\""),
            device: "flex".into(),
            command: format!("clift eval {HOSTILE}"),
        },
        summary: summary(),
        training: vec![TrainingCurve { stage: "stage1", training: vec![(1, 9.0)], validation: vec![(1, 8.0)] }],
        skipped,
        figures: vec![figure()],
    }
}

fn page(report: &Report) -> String {
    report.to_html().unwrap()
}

#[test]
fn pages_have_all_sections_and_no_external_resources() {
    let html = page(&report());
    for part in [
        "<h2>Quality and cost</h2>",
        "<h2>All points</h2>",
        "<h2>Images of scenes</h2>",
        "<h2>Training</h2>",
        "<h2>Skipped scenes</h2>",
        "<h2>Command and machine</h2>",
        "<h2>Config</h2>",
        "Quality against stored tokens",
        "Quality against the size of a scene",
        "Quality against rendered tokens",
        "Quality against time per frame",
        "Pareto front",
        "nearest view",
        "4 clusters",
        "2 of 8 tokens selected for the target",
        "2 of 3 scenes were evaluated",
        "training, step 1: 9.00 dB",
        "validation, step 1: 8.00 dB",
        "error, 8 tokens",
        "clift eval ",
        env!("CARGO_PKG_VERSION"),
        "data.root = ",
    ] {
        assert!(html.contains(part), "{part} is missing");
    }
    for outside in ["http", "<script", "<link", "@import", "url("] {
        assert!(!html.contains(outside), "{outside}");
    }
    for address in html.split("href=\"").skip(1).chain(html.split("src=\"").skip(1)) {
        assert!(address.starts_with("data:image/png;base64,") || address.starts_with("#s0v"), "{address:.40}");
    }
    assert_eq!(html.matches("<img").count(), html.matches(" alt=\"").count(), "a text for every image");
    assert_eq!(html.matches("role=\"img\"").count(), html.matches("role=\"img\" aria-label=\"").count());
    // Title, heading, scene, skip reason, command and config.
    assert_eq!(html.matches("&lt;script&gt;alert('room')&lt;/script&gt;").count(), 6);
    assert_eq!(html.matches("<table").count(), html.matches("<div class=\"scroll\"><table").count(), "tables scroll");
    // Time: 1 ms and 15 dB, 2 ms and 16.5 dB, 3 ms and 18.5 dB; the random subset shares the time of the second.
    // Bytes: 4,000 and 16.5 dB, 8,000 and 18.5 dB; the point with 15 dB has 8,000 bytes too.
    assert_eq!(html.matches("<td>\u{25cf}</td>").count(), 3 + 2);
    let random = html.split("<tr").find(|row| row.contains("<td>random</td>")).unwrap();
    assert!(!random.contains('\u{25cf}'), "{random}");
}

#[test]
fn pages_without_selections_or_points_explain_the_gap() {
    let mut plain = report();
    plain.summary.points.retain(|point| point.key.is_whole());
    plain.figures[0].selections.clear();
    plain.summary.masked_share = Some(0.25);
    let html = page(&plain);
    assert!(html.contains("25.0 % of the target pixels are masked"), "{html}");
    assert!(html.contains("--render 1/4,1/2") && !html.contains("Quality against rendered tokens"));
    plain.summary.points.clear();
    plain.figures.clear();
    plain.training.clear();
    plain.skipped = SkipReport::default();
    let html = page(&plain);
    assert!(!html.contains("<h2>Training</h2>"));
    assert!(html.contains("No measured points") && html.contains("eval.num_sheets"), "{html}");
}

#[test]
fn pages_of_many_large_scenes_stay_below_ten_megabytes() {
    let mut large = report();
    let mut scene = figure();
    // Noise, which PNG cannot compress, and the counts of the paper's main experiment.
    let mut state = 1_u32;
    let mut noise = || {
        let byte = |_| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        };
        Canvas::from_rgb8(&(0..128 * 128 * 3).map(byte).collect::<Vec<_>>(), 128, 128).unwrap()
    };
    (scene.context, scene.context_frames) = ((0..6).map(|_| noise()).collect(), (0..6).collect());
    scene.images.clear();
    for method in [Method::Clift, Method::Kmeans, Method::Random] {
        for stored in [256, 512, 1024, 2048, 3072, 4096] {
            scene.images.push(FigureImage {
                key: key(method, stored, stored),
                psnr: 20.0,
                image: noise(),
                error: Some(noise()),
            });
        }
    }
    large.figures = vec![scene; 100];
    let bytes = page(&large).len();
    assert!(bytes < 10_000_000, "{bytes}");
}

#[test]
fn external_methods_are_escaped_everywhere_and_missing_images_noted() {
    let name = MethodName::new("<b>\" onload=\"MVSplat").unwrap();
    let mut other = report();
    let mut results = EvalResults::default();
    let key = EvalKey::baseline(Method::External(name));
    results.add("a", 3, key, ViewMetrics::quality(17.0, Some(0.5)));
    results.add_scene_bytes(key, 5_000);
    results.record_missing_image(Method::External(name), "b/000003.png".into());
    results.note_not_measured("lpips_vgg", "no <weights>".into());
    let summary = Summary::new(&results);
    other.summary.points.extend(summary.points);
    (other.summary.missing, other.summary.not_measured) = (summary.missing, summary.not_measured);
    other.figures[0].images.push(FigureImage { key, psnr: 17.0, image: Canvas::new(16, 16, [9; 3]), error: None });
    other.run.name = "a\u{7}&".into();
    let html = page(&other);
    let escaped = "&lt;b&gt;&quot; onload=&quot;MVSplat";
    for part in [
        "<h1>a\u{fffd}&amp;</h1>".to_owned(),
        format!("<td>{escaped}</td>"),
        format!("<h4>{escaped}</h4>"),
        format!("</svg>{escaped}</li>"),
        format!("alt=\"The target rendered by {escaped}"),
        format!("{escaped}: 1 of 2 images are missing"),
        "<code>lpips_vgg</code> is not measured: no &lt;weights&gt;".into(),
    ] {
        assert!(html.contains(&part), "{part}");
    }
    for part in ["<b>", "onload=\"", "NaN", "inf\""] {
        assert!(!html.contains(part), "{part}");
    }
}

#[test]
fn several_formats_have_lines_of_their_own() {
    let mut several = report();
    assert!(!page(&several).contains("clift, f32"), "a single format is not named");
    let points = several.summary.points.clone();
    let coarse = points.into_iter().filter(|point| point.key.method == Method::Clift).map(|mut point| {
        point.key.tokens = Some(TokenCoding::INT8);
        point.cost.scene_bytes = point.cost.scene_bytes.map(|bytes| bytes / 4);
        point
    });
    several.summary.points.extend(coarse);
    let html = page(&several);
    for part in ["</svg>clift, f32</li>", "</svg>clift, int8</li>", "</svg>random</li>", "<td>int8</td>"] {
        assert!(html.contains(part), "{part}");
    }
}
