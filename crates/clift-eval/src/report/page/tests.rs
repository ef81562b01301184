use clift_model::{SceneClusters, TokenFormat};

use super::*;
use crate::config::method::{Method, MethodName};
use crate::figures::canvas::Canvas;
use crate::figures::scene_figure::{Drawing, FigureTokens};
use crate::statistics::eval_results::EvalResults;
use crate::statistics::view_metrics::{EvalKey, ViewMetrics};

const HOSTILE: &str = "<script>alert('room')</script>";

fn setting(variant: Method, num_storage_tokens: usize, num_render_tokens: usize) -> EvalKey {
    EvalKey { variant, num_storage_tokens, num_render_tokens, tokens: Some(TokenFormat::F32) }
}

/// Two variants at two counts and one choice, over two scenes.
fn summary() -> Summary {
    let mut views = EvalResults::default();
    for (scene, shift) in [("a", 0.0), ("b", 1.0)] {
        views
            .add(scene, 3, EvalKey::baseline(Method::NearestView), ViewMetrics::quality(15.0 + shift, Some(0.4)))
            .unwrap();
        for (variant, stored, rendered, psnr, ms) in [
            (Method::Clift, 4, 4, 16.0, 2.0),
            (Method::Clift, 8, 8, 18.0, 3.0),
            (Method::Clift, 8, 2, 14.5, 1.0),
            (Method::Random, 4, 4, 14.0, 2.5),
        ] {
            let setting = setting(variant, stored, rendered);
            let measured =
                ViewMetrics { render_s: Some(ms * 1e-3), ..ViewMetrics::quality(psnr + shift, Some(psnr / 40.0)) };
            views.add(scene, 3, setting, measured).unwrap();
            if variant == Method::Clift {
                views.add_scene_bytes(setting, 1000 * stored as u64);
            }
        }
    }
    Summary::new(&views)
}

/// A scene of two views of 2 x 2 patches.
fn exhibit(side: usize) -> SceneFigure {
    let picture = |level| Canvas::new(side, side, [level; 3]);
    let drawing = |variant, stored, rendered| {
        let setting = if stored == 0 { EvalKey::baseline(variant) } else { setting(variant, stored, rendered) };
        Drawing { setting, psnr: 17.25, picture: picture(90) }
    };
    SceneFigure {
        key: HOSTILE.into(),
        grid: [2, 2],
        context: vec![picture(10), picture(20)],
        context_frames: vec![0, 7],
        target: picture(50),
        target_frame: 3,
        drawings: vec![
            drawing(Method::NearestView, 0, 0),
            drawing(Method::Clift, 4, 4),
            drawing(Method::Clift, 8, 2),
            drawing(Method::Clift, 8, 8),
        ],
        clusters: vec![
            SceneClusters::new(vec![0, 0, 1, 1, 2, 2, 3, 3], vec![1, 2, 4, 7]).unwrap(),
            SceneClusters::identity(8),
        ],
        choices: vec![FigureTokens {
            setting: setting(Method::Clift, 8, 2),
            stored: (0..8).collect(),
            chosen: vec![1, 6],
        }],
    }
}

fn report() -> Report {
    let mut ledger = SkipReport::new(3);
    ledger.skip("c", format!("bad frame {HOSTILE}"));
    Report {
        name: format!("run {HOSTILE}"),
        summary: summary(),
        ledger,
        exhibits: vec![exhibit(16)],
        config: format!("data.root = \"{HOSTILE}\""),
        device: "flex".into(),
    }
}

fn page(report: &Report) -> String {
    report.to_html().unwrap()
}

#[test]
fn the_page_has_every_section_and_needs_nothing_from_outside() {
    let html = page(&report());
    for part in [
        "Quality against stored tokens",
        "Quality against the size of a scene",
        "Quality against rendered tokens",
        "Quality against time per frame",
        "Pareto front",
        "All points",
        "nearest view",
        "context views",
        "4 clusters",
        "2 of 8 tokens chosen for the target",
        "2 of 3 scenes were evaluated",
        "Machine",
        env!("CARGO_PKG_VERSION"),
        "data.root = ",
        "prefers-color-scheme: dark",
    ] {
        assert!(html.contains(part), "{part} is missing");
    }
    // No script, no address but pictures in the page and names in it.
    for outside in ["http", "<script", "<link", "@import", "url("] {
        assert!(!html.contains(outside), "{outside}");
    }
    for address in html.split("href=\"").skip(1).chain(html.split("src=\"").skip(1)) {
        assert!(address.starts_with("data:image/png;base64,") || address.starts_with("#s0v"), "{address:.40}");
    }
    assert_eq!(html.matches("<img").count(), html.matches(" alt=\"").count(), "a text for every picture");
    assert_eq!(html.matches("role=\"img\"").count(), html.matches("role=\"img\" aria-label=\"").count());
}

#[test]
fn tags_are_closed_in_the_order_they_are_opened() {
    let mut open = Vec::new();
    for tag in page(&report()).split('<').skip(1).map(|tag| tag.split('>').next().unwrap()) {
        let name = tag.split_whitespace().next().unwrap();
        if let Some(closed) = name.strip_prefix('/') {
            assert_eq!(open.pop(), Some(closed.to_owned()));
        } else if !tag.ends_with('/') && !["!DOCTYPE", "meta", "br", "img"].contains(&name) {
            open.push(name.to_owned());
        }
    }
    assert!(open.is_empty(), "{open:?}");
}

#[test]
fn no_text_from_data_is_read_as_markup() {
    let html = page(&report());
    // Title, heading, scene, ledger and config.
    assert_eq!(html.matches("&lt;script&gt;alert('room')&lt;/script&gt;").count(), 5);
    // In an attribute too, and characters that HTML cannot express are replaced.
    let mut quoted = report();
    quoted.name = "a\" onload=\"b\u{7}&".into();
    quoted.exhibits[0].drawings[0].setting.variant = Method::System(MethodName::new("\" onload=\"b").unwrap());
    let html = page(&quoted);
    assert!(html.contains("<h1>a&quot; onload=&quot;b\u{fffd}&amp;</h1>") && !html.contains("onload=\""), "{html}");
    assert!(html.contains("alt=\"The target as &quot; onload=&quot;b draws it"), "{html}");
}

#[test]
fn the_points_on_the_pareto_front_are_marked() {
    let html = page(&report());
    // Time: 1 ms and 15 dB, 2 ms and 16.5 dB, 3 ms and 18.5 dB; the random subset is slower and worse than the second.
    // Bytes: 4,000 and 16.5 dB, 8,000 and 18.5 dB; those with 15 dB take 8,000 as well.
    assert_eq!(html.matches("<td>\u{25cf}</td>").count(), 3 + 2);
    let random = html.split("<tr").find(|row| row.contains("<td>random</td>")).unwrap();
    assert!(!random.contains('\u{25cf}'), "{random}");
}

#[test]
fn an_evaluation_without_choices_says_how_to_get_them_and_one_without_points_is_still_a_page() {
    let mut plain = report();
    plain.summary.points.retain(|point| point.num_render_tokens == point.num_storage_tokens);
    plain.exhibits[0].choices.clear();
    let html = page(&plain);
    assert!(html.contains("--render 1/4,1/2") && !html.contains("Quality against rendered tokens"));

    plain.summary.points.clear();
    plain.exhibits.clear();
    plain.ledger = SkipReport::default();
    let html = page(&plain);
    assert!(html.contains("Nothing was measured") && html.contains("eval.num_sheets"), "{html}");
}

#[test]
fn a_page_of_many_large_scenes_stays_below_ten_megabytes() {
    let mut large = report();
    let mut scene = exhibit(128);
    // Noise, which no PNG makes smaller, and the counts of the paper's main experiment.
    let mut state = 1_u32;
    let mut noise = || {
        let byte = |_| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        };
        Canvas::from_rgb8(&(0..128 * 128 * 3).map(byte).collect::<Vec<_>>(), 128, 128).unwrap()
    };
    scene.context = (0..6).map(|_| noise()).collect();
    scene.context_frames = (0..6).collect();
    scene.drawings.clear();
    for variant in [Method::Clift, Method::Kmeans, Method::Random] {
        for stored in [256, 512, 1024, 2048, 3072, 4096] {
            scene.drawings.push(Drawing { setting: setting(variant, stored, stored), psnr: 20.0, picture: noise() });
        }
    }
    large.exhibits = vec![scene; 100];
    let bytes = large.to_html().unwrap().len();
    assert!(bytes < 10_000_000, "{bytes}");
}

#[test]
fn a_report_that_cannot_be_written_says_where() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("missing").join("report.html");
    let message = report().write(&path).unwrap_err().to_string();
    assert!(message.starts_with("writing the report failed: ") && message.ends_with("report.html"), "{message}");
    let path = folder.path().join("report.html");
    report().write(&path).unwrap();
    assert!(std::fs::read_to_string(&path).unwrap().ends_with("</html>"));
}

#[test]
fn other_systems_stand_in_tables_plots_and_scenes_with_what_they_miss() {
    let name = MethodName::new("<b>MVSplat</b>").unwrap();
    let mut other = report();
    let mut views = EvalResults::default();
    let setting = EvalKey::baseline(Method::System(name));
    views.add("a", 3, setting, ViewMetrics::quality(17.0, Some(0.5))).unwrap();
    views.add_scene_bytes(setting, 5_000);
    views.miss(name, "b/000003.png".into());
    views.note_not_measured("lpips_vgg", "no <weights>".into());
    let theirs = Summary::new(&views);
    other.summary.points.extend(theirs.points);
    (other.summary.missing, other.summary.not_measured) = (theirs.missing, theirs.not_measured);
    other.exhibits[0].drawings.push(Drawing { setting, psnr: 17.0, picture: Canvas::new(16, 16, [9; 3]) });
    let html = page(&other);
    let escaped = "&lt;b&gt;MVSplat&lt;/b&gt;";
    assert!(!html.contains("<b>MVSplat"), "a name is no markup");
    assert!(html.contains(&format!("<td>{escaped}</td>")), "table");
    assert!(html.contains(&format!("<h4>{escaped}</h4>")), "scene");
    assert!(html.contains(&format!("</svg>{escaped}</li>")), "legend");
    assert!(html.contains(&format!("{escaped}: 1 of 2 pictures are missing")), "{html}");
    assert!(html.contains("<code>lpips_vgg</code> is not measured: no &lt;weights&gt;"));
    assert!(!html.contains("NaN") && !html.contains("inf\""), "no place for zero tokens on an axis of logarithms");
}

#[test]
fn several_formats_have_lines_of_their_own() {
    let mut several = report();
    let mut coarse: Vec<SummaryPoint> =
        several.summary.points.iter().filter(|point| point.variant == Method::Clift).cloned().collect();
    for point in &mut coarse {
        (point.tokens, point.scene_bytes) = (Some(TokenFormat::Int8), point.scene_bytes.map(|bytes| bytes / 4));
    }
    several.summary.points.extend(coarse);
    let html = page(&several);
    for part in ["</svg>clift, f32</li>", "</svg>clift, int8</li>", "</svg>random</li>", "<td>int8</td>"] {
        assert!(html.contains(part), "{part}");
    }
    assert!(!page(&report()).contains("clift, f32"), "one format needs no telling apart");
}
