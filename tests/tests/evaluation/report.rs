//! The HTML report of an evaluation, and evaluations that render from selected tokens.

use crate::support::{Place, STAGE_1, WHOLE};

#[test]
fn reports_need_no_other_file() {
    let place = Place::new();
    place.copy(&WHOLE, "run");
    let html = place.text("run/eval/report.html");
    for part in ["<title>run", "synthetic-0-test-00000", "3 of 3 scenes were evaluated", "num_encoder_blocks = 1"] {
        assert!(html.contains(part), "{part}");
    }
    for section in ["Quality and cost", "All points", "Scenes", "Skipped scenes", "Machine", "Config"] {
        assert!(html.contains(&format!("<h2>{section}</h2>")), "{section}");
    }
    assert!(!html.contains("http") && !html.contains("tokens selected"));
    assert_eq!(html.matches("<article").count(), 1, "eval.num_sheets = 1");
    // Pictures of 16 x 16 pixels: styles, plots and config are most of it.
    assert!(html.len() < 200_000, "{} bytes", html.len());

    let out = place.at("elsewhere");
    let flags = ["--render", "1/2", "--set", "eval.num_sheets=2", "--out", out.to_str().unwrap()];
    let ran = place.eval("run", &flags).ok();
    assert!(ran.stdout.contains("elsewhere/report.html"), "{}", ran.stdout);
    let chosen = place.text("elsewhere/report.html");
    assert!(chosen.contains("4 of 8 tokens selected") && chosen.contains("Quality against rendered tokens"));
    assert_eq!(chosen.matches("<article").count(), 2);
    assert_eq!(place.text("run/eval/report.html"), html, "--out leaves the run's own report alone");
}

#[test]
fn selected_tokens_have_rows_with_both_times() {
    let place = Place::new();
    place.copy(&STAGE_1, "run");
    for selection in ["paper", "global", "scaled", "random"] {
        let out = place.at(selection);
        let flags = ["--render", "2,1/2", "--selection", selection, "--out", out.to_str().unwrap()];
        place.eval("run", &flags).ok();
        let summary = place.json(&format!("{selection}/summary.json"));
        let points = summary["points"].as_array().expect("a list");
        let counts = |point: &serde_json::Value| {
            ["num_storage_tokens", "num_render_tokens"].map(|key| point[key].as_u64().expect("a count"))
        };
        let kmeans: Vec<_> = points.iter().filter(|point| point["variant"] == "kmeans").collect();
        let settings: Vec<[u64; 2]> = kmeans.iter().map(|point| counts(point)).collect();
        // Two is half of four: once.
        assert_eq!(settings, [[4, 2], [4, 4], [8, 2], [8, 4], [8, 8]]);
        for point in kmeans {
            let [stored, rendered] = counts(point);
            assert!(point["render_s"].as_f64().expect("a time") > 0.0 && point["psnr"].is_f64(), "{point}");
            assert_eq!(point["select_s"].is_f64(), rendered < stored, "{point}");
            assert!(point["scene_bytes"].is_u64(), "{point}");
        }
        let views = place.text(&format!("{selection}/views.csv"));
        let chosen = views.lines().filter(|line| line.contains(",kmeans,8,2,"));
        // Three scenes of two targets.
        assert_eq!(chosen.filter(|line| !line.ends_with(',')).count(), 6, "{views}");
    }
    let quality = |selection: &str| {
        let points = place.json(&format!("{selection}/summary.json"))["points"].clone();
        let mut points: Vec<_> = points.as_array().expect("a list").clone();
        points.retain(|point| point["num_storage_tokens"] == 8 && point["num_render_tokens"] == 2);
        points.iter().map(|point| point["psnr"].as_f64().expect("a number")).collect::<Vec<_>>()
    };
    assert_ne!(quality("paper"), quality("random"));
}

#[test]
fn render_counts_at_or_above_storage_are_refused() {
    let place = Place::new();
    place.copy(&STAGE_1, "run");
    for count in ["8", "1.0", "400"] {
        place.eval("run", &["--render", count]).fails_with(2, &["`eval.render`", "less than 8"]);
    }
    place.eval("run", &["--set", "eval.selection=\"nearest\""]).fails_with(2, &["paper, global, scaled, random"]);
}
