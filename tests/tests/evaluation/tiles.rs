//! Tiles against K-means, with the same stage 1.

use crate::support::{Place, Shared, WHOLE, list, number, point};

/// At least one tile per view.
const STORAGE: &str = "eval.validation_stored_tokens=0.5";

/// The run of tiles, whose stage 1 is that of [`WHOLE`].
static TILES: Shared = Shared::new("run", &["clusters.grouping=\"tile\"", STORAGE]);

#[test]
fn tiles_and_clusters_have_paired_differences() {
    let place = Place::with(&WHOLE);
    place.copy(&TILES, "tiles");
    let words = "run --preset patchwise --with DIR/tiles --stored-tokens 1/2 --out DIR/out";
    place.eval(words).ok().prints("kmeans - tile").prints("tile_clift");
    let summary = place.json("out/summary.json");
    let points = list(&summary["points"]);
    let psnr = |variant: &str| number(point(points, variant, 4), "psnr");
    assert_eq!(points.len(), 4, "what the preset names: {summary}");
    let differences = list(&summary["differences"]);
    let pairs = [["kmeans", "tile"], ["tile_clift", "tile"], ["clift", "kmeans"], ["clift", "tile_clift"]];
    assert_eq!(differences.len(), pairs.len(), "{summary}");
    for [variant, against] in pairs {
        let difference = differences.iter().find(|d| d["method"] == variant && d["against"] == against).unwrap();
        // Every scene has the same number of views, so that the difference of the means is the mean difference.
        let expected = psnr(variant) - psnr(against);
        assert!((number(difference, "psnr") - expected).abs() < 1e-9, "{difference}, {expected}");
        assert!(number(difference, "psnr_stderr") >= 0.0 && difference["num_scenes"] == 3);
    }

    // Without condenser both are of stage 1, which the two runs share: the tiles' own evaluation agrees.
    let own = place.points("tiles/eval");
    let names: Vec<_> = own.iter().map(|point| point["method"].as_str().unwrap()).collect();
    assert!(!names.contains(&"clift") && names.contains(&"tile_clift"), "{names:?}");
    assert_eq!(number(point(&own, "tile", 4), "psnr"), psnr("tile"));
}

#[test]
fn tile_runs_encode_scenes_and_refuse_their_kind() {
    let place = Place::with(&WHOLE);
    place.copy(&TILES, "tiles");
    place
        .train("few", &["clusters.grouping=\"tile\""])
        .fails_with(2, &["eval.validation_stored_tokens", "at least one tile for every context view"]);
    place.eval("run --with DIR/run").fails_with(2, &["trained on the same groups of tokens"]);
    let patchwise = place.eval("run --preset patchwise --stored-tokens 1/2");
    patchwise.fails_with(2, &["clusters.grouping = \"tile\"", "--with"]);
    let encode = "encode DIR/tiles --scene synthetic-0-test-00000 --stored-tokens 4 -o DIR/room.clift";
    place.clift(encode).ok().prints("4 of 8 tokens");
    place.clift("render DIR/room.clift --path orbit --frames 2 -o DIR/orbit").ok();
    place.clift("codec DIR/tiles").fails_with(2, &["clusters.grouping", "the token codec is one of K-means tokens"]);

    // Another stage 1, another encoder: its condenser has never seen these tokens.
    place.train("other", &["seed=1", "clusters.grouping=\"tile\"", STORAGE]).ok();
    place.eval("run --with DIR/other").fails_with(1, &["other/stage2/model.safetensors"]);
}
