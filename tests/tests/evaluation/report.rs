//! The HTML report of an evaluation, and evaluations that render from selected tokens.

use crate::support::{Place, STAGE_1, WHOLE, number};

#[test]
fn reports_need_no_other_file() {
    let place = Place::with(&WHOLE);
    let html = place.text("run/eval/report.html");
    for part in [
        "<title>run",
        "synthetic-0-test-00000",
        "3 of 3 scenes were evaluated",
        "num_encoder_blocks = 1",
        "validation, step 6: ",
        "error, 8 tokens",
        "test split",
        "micro.toml",
    ] {
        assert!(html.contains(part), "{part}");
    }
    assert!(!html.contains("http") && !html.contains("tokens selected"));
    assert_eq!(html.matches("<article").count(), 1, "eval.num_sheets = 1");
    // Pictures of 16 x 16 pixels: styles, plots and config are most of it.
    assert!(html.len() < 200_000, "{} bytes", html.len());
    let ran = place.eval("run --render 1/2 --set eval.num_sheets=2 --out DIR/elsewhere").ok();
    ran.prints("elsewhere/report.html");
    let chosen = place.text("elsewhere/report.html");
    assert!(chosen.contains("4 of 8 tokens selected") && chosen.contains("Quality against rendered tokens"));
    assert_eq!(chosen.matches("<article").count(), 2);
    assert_eq!(place.text("run/eval/report.html"), html, "--out leaves the run's own report alone");
}

#[test]
fn selected_tokens_have_rows_with_both_times() {
    let place = Place::with(&STAGE_1);
    for selection in ["paper", "random"] {
        place.eval(&format!("run --render 2,1/2 --selection {selection} --out DIR/{selection}")).ok();
        let points = place.points(selection);
        let counts = |point: &serde_json::Value| {
            ["num_storage_tokens", "num_render_tokens"].map(|key| point[key].as_u64().expect("a count"))
        };
        let kmeans: Vec<_> = points.iter().filter(|point| point["method"] == "kmeans").collect();
        let settings: Vec<[u64; 2]> = kmeans.iter().map(|point| counts(point)).collect();
        // Two is half of four: once.
        assert_eq!(settings, [[4, 2], [4, 4], [8, 2], [8, 4], [8, 8]]);
        for point in kmeans {
            let [stored, rendered] = counts(point);
            assert!(number(point, "render_s") > 0.0 && point["psnr"].is_f64(), "{point}");
            assert_eq!(point["select_s"].is_f64(), rendered < stored, "{point}");
            assert!(point["scene_bytes"].is_u64(), "{point}");
        }
        let views = place.text(&format!("{selection}/views.csv"));
        let chosen = views.lines().filter(|line| line.contains(",kmeans,8,2,"));
        // Three scenes of two targets.
        let has_format = |line: &&str| line.split(',').nth(11).is_some_and(|format| !format.is_empty());
        assert_eq!(chosen.filter(has_format).count(), 6, "{views}");
    }
    let quality = |selection: &str| {
        let mut points = place.points(selection);
        points.retain(|point| point["num_storage_tokens"] == 8 && point["num_render_tokens"] == 2);
        points.iter().map(|point| number(point, "psnr")).collect::<Vec<_>>()
    };
    assert_ne!(quality("paper"), quality("random"));
}

#[test]
fn render_counts_at_or_above_storage_are_refused() {
    let place = Place::with(&STAGE_1);
    for count in ["8", "1.0", "400"] {
        place.eval(&format!("run --render {count}")).fails_with(2, &["`eval.render`", "less than 8"]);
    }
    place
        .eval("run --set eval.selection=\"nearest\"")
        .fails_with(2, &["\"paper\", \"global\", \"scaled\", \"random\""]);
}
