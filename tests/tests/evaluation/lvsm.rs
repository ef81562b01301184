//! LVSM's encoder-decoder: one stage of training, evaluation beside `CLiFT`, scene files.

use crate::support::{Place, Shared, WHOLE, number, point};

const LVSM: [&str; 4] = [
    "model.architecture=\"lvsm-ed\"",
    "model.num_latents=5",
    "model.condenser={num_blocks=0}",
    "stage1.keep_tokens=[1.0, 1.0]",
];
const MUON: &str = "stage1.optimizer={algorithm=\"muon\", learning_rate=1e-3, warm_up_steps=2}";
static FIVE: Shared = Shared::new("run", &LVSM);

#[test]
fn its_one_stage_trains_and_resumes_exactly() {
    let place = Place::new();
    let longer = ["stage1.steps=30", "checkpoint={every=17, keep=2}", "eval.every=17"];
    for (name, set) in [("plain", &[][..]), ("muon", &[MUON])] {
        let set = [&LVSM[..], &longer, set].concat();
        let [whole, parts] = ["whole", "parts"].map(|part| format!("{part}-{name}"));
        place.train(&whole, &set).ok().prints("lvsm_ed");
        assert!(!place.at(&format!("{whole}/stage2")).exists() && !place.at(&format!("{whole}/clusters")).exists());
        place.kill_at("step/stage1/25", &parts, &set);
        place.train(&parts, &set).ok().notes("stage1: resumed after 17 of 30 steps");
        assert!(place.weights(&whole, "stage1") == place.weights(&parts, "stage1"), "{name}");
        assert_eq!(place.metrics_but_time(&whole), place.metrics_but_time(&parts));
        assert_eq!(place.summary_but_time(&whole), place.summary_but_time(&parts));
        place.train(&whole, &set).ok().notes("the run is trained and evaluated");
    }
    place.train("other --only stage2", &LVSM).fails_with(2, &["`--only` = stage2", "lvsm-ed\" has one stage"]);
    place
        .train("subsets", &LVSM[..3])
        .fails_with(2, &["`stage1.keep_tokens`", "renders from all tokens: write [1.0, 1.0]"]);
}

#[test]
fn several_sizes_stand_beside_clift_in_one_evaluation() {
    let place = Place::with(&WHOLE);
    place.copy(&FIVE, "five");
    let three = [&LVSM[..1], &["model.num_latents=3"], &LVSM[2..]].concat();
    place.train("three", &three).ok();
    let words = "run --preset main --stored-tokens 1/2 --with DIR/five --with DIR/three --out DIR/out";
    place.eval(words).ok().prints("lvsm_ed");
    let points = place.points("out");
    assert_eq!(points.len(), 5, "f16 and two coded of CLiFT, two sizes of LVSM: {points:?}");
    place.eval("five --format f16").ok();
    for (name, count) in [("five", 5), ("three", 3)] {
        let found = point(&points, "lvsm_ed", count);
        assert_eq!(
            (found["scene_values"].as_u64(), found["num_render_tokens"].as_u64()),
            (Some(16 * count as u64), Some(count as u64))
        );
        place.clift(&format!("encode DIR/{name} --scene synthetic-0-test-00000 -o DIR/{name}.clift")).ok();
        assert_eq!(found["scene_bytes"].as_u64(), Some(place.bytes(&format!("{name}.clift")).len() as u64));
    }
    let own = place.points("five/eval");
    assert_eq!(number(point(&own, "lvsm_ed", 5), "psnr"), number(point(&points, "lvsm_ed", 5), "psnr"));

    place.eval("run --with DIR/five --with DIR/five").fails_with(2, &["as many latents"]);
    place.eval("five --render 2").fails_with(2, &["`eval.render`", "are rendered from all tokens"]);
    place.eval("five --preset main").fails_with(2, &["has the method lvsm_ed alone"]);
    place.clift("codec DIR/five").fails_with(2, &["`model.architecture`"]);
}

#[test]
fn latents_are_stored_and_rendered_whole() {
    let place = Place::with(&FIVE);
    let encode = "encode DIR/run --scene synthetic-0-test-00000 -o DIR/room.clift";
    let encoded = place.clift(&format!("{encode} --format f32")).ok().prints("5 of 5 tokens (latents, f32)");
    assert!(!encoded.stdout.contains("clusters"), "{}", encoded.stdout);
    place.clift("render DIR/room.clift --path interpolate --frames 3 -o DIR/frames").ok().prints("5 of 5 tokens");
    place.clift("export DIR/run -o DIR/half").ok();
    place.clift("export DIR/run -o DIR/half").fails_with(2, &["the path exists"]);
    place.clift("plan DIR/run/config.toml").ok().prints("stage1");

    place
        .clift("render DIR/room.clift --path orbit --render 2 -o DIR/few")
        .fails_with(2, &["none can be selected by the camera"]);
    place.clift("view DIR/room.clift --no-open").fails_with(2, &["learned tokens of lvsm-ed lie nowhere"]);
    for (flags, part) in [("--stored-tokens 2", "not clustered: write 5"), ("--format coded", "have no codec")] {
        place.clift(&format!("{encode} --force {flags}")).fails_with(2, &[part]);
    }
    // The network of a scene is part of it.
    place.train("other", &[&LVSM[..], &["seed=1"]].concat()).ok();
    place
        .clift("render DIR/room.clift --path orbit --model DIR/other -o DIR/few")
        .fails_with(2, &["the scene was made for the renderer"]);
}
