//! Tiles against K-means, with the same stage 1.

use crate::support::{Place, WHOLE, clift};

/// At least one tile per view.
const STORAGE: &str = "eval.validation_storage=0.5";

/// Trains stage 2 of the run `name` on tiles, from the stage 1 of `run`.
fn train_on_tiles(place: &Place, name: &str) {
    let from = format!("stage1.init_from=\"{}\"", place.at("run").display());
    place.train(name, &["stage1.steps=0", &from, "clusters.grouping=\"tile\"", STORAGE], &[]).ok();
}

#[test]
fn tiles_and_clusters_have_paired_differences() {
    let place = Place::new();
    place.copy(&WHOLE, "run");
    train_on_tiles(&place, "tiles");
    let tiles = place.at("tiles").display().to_string();
    let out = place.at("out").display().to_string();
    let ran = place.eval("run", &["--preset", "patchwise", "--with", &tiles, "--storage", "1/2", "--out", &out]).ok();

    let summary = place.json("out/summary.json");
    let points = summary["points"].as_array().unwrap();
    let psnr = |variant: &str| {
        let point = points.iter().find(|point| point["variant"] == variant).unwrap_or_else(|| panic!("{variant}"));
        assert_eq!(point["num_storage_tokens"], 4);
        point["psnr"].as_f64().unwrap()
    };
    assert_eq!(points.len(), 4, "what the preset names: {summary}");
    let differences = summary["differences"].as_array().unwrap();
    let pairs = [["kmeans", "patch"], ["patch_clift", "patch"], ["clift", "kmeans"], ["clift", "patch_clift"]];
    assert_eq!(differences.len(), pairs.len(), "{summary}");
    for [variant, against] in pairs {
        let difference = differences.iter().find(|d| d["variant"] == variant && d["against"] == against).unwrap();
        // Every scene has the same number of views, so that the difference of the means is the mean difference.
        let expected = psnr(variant) - psnr(against);
        assert!((difference["psnr"].as_f64().unwrap() - expected).abs() < 1e-9, "{difference}, {expected}");
        assert!(difference["psnr_stderr"].as_f64().unwrap() >= 0.0 && difference["num_scenes"] == 3);
    }
    assert!(ran.stdout.contains("kmeans - patch") && ran.stdout.contains("patch_clift"), "{}", ran.stdout);

    // Without condenser both are of stage 1, which the two runs share: the tiles' own evaluation agrees.
    let own = place.json("tiles/eval/summary.json");
    let own = own["points"].as_array().unwrap();
    let names: Vec<_> = own.iter().map(|point| point["variant"].as_str().unwrap()).collect();
    assert!(!names.contains(&"clift") && names.contains(&"patch_clift"), "{names:?}");
    let patch = own.iter().find(|point| point["variant"] == "patch" && point["num_storage_tokens"] == 4).unwrap();
    assert_eq!(patch["psnr"].as_f64().unwrap(), psnr("patch"));
}

#[test]
fn tile_runs_encode_nothing_and_refuse_their_kind() {
    let place = Place::new();
    place.copy(&WHOLE, "run");
    train_on_tiles(&place, "tiles");
    place
        .train("few", &["clusters.grouping=\"tile\""], &[])
        .fails_with(2, &["eval.validation_storage", "at least one tile for every context view"]);
    let run = place.at("run").display().to_string();
    let tiles = place.at("tiles").display().to_string();
    place.eval("run", &["--with", &run]).fails_with(2, &["trained on the same groups of tokens"]);
    place
        .eval("run", &["--preset", "patchwise", "--storage", "1/2"])
        .fails_with(2, &["clusters.grouping = \"tile\"", "--with"]);
    let file = place.at("room.clift").display().to_string();
    clift(["encode", &tiles, "--scene", "synthetic-0-test-00000", "-o", &file]).fails_with(2, &["clusters.grouping"]);

    // Another stage 1, another encoder: its condenser has never seen these tokens.
    place.train("other", &["seed=1", "clusters.grouping=\"tile\"", STORAGE], &[]).ok();
    let other = place.at("other").display().to_string();
    place.eval("run", &["--with", &other]).fails_with(1, &["other/stage2/model.safetensors"]);
}
