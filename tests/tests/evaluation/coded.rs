//! Coded scene files through the command line: fitted, encoded, evaluated.

use clift_scene::{Scene, TokenCodec, TokenCoding};

use crate::support::{LONGER, Place, STAGE_1, WHOLE, number, point};

const KEY: &str = "synthetic-0-test-00000";
const CODEC: &str = "run/stage2/codec.safetensors";

/// Encodes the first test scene, with the contexts of `clift eval`, into `room.clift`.
fn encode(place: &Place, flags: &str) -> crate::support::Ran {
    place.clift(&format!("encode DIR/run --scene {KEY} --context 0,7 --out DIR/room.clift --force {flags}"))
}

#[test]
fn coded_files_have_the_size_and_quality_of_the_evaluation() {
    let place = Place::with(&LONGER);
    place.eval("run --format f32,coded,coded-1 --set eval.num_scenes=1 --out DIR/coded").ok();
    let points = place.points("coded");
    let of =
        |tokens: &str, count: usize| point(points.iter().filter(|point| point["tokens"] == tokens), "clift", count);
    encode(&place, "").ok().prints("(clift, coded, expected loss 0.02 dB)");
    for tokens in ["coded", "coded-1"] {
        for count in [4, 8] {
            encode(&place, &format!("--stored-tokens {count} --format {tokens}"))
                .ok()
                .prints("(clift, coded, expected loss");
            let bytes = place.bytes("room.clift").len() as u64;
            assert_eq!(of(tokens, count)["scene_bytes"], bytes, "{tokens}, {count}");
            let (scene, storage) = Scene::read(&place.at("room.clift")).unwrap();
            assert!(scene.num_tokens() == count && matches!(storage, TokenCoding::Coded(_)), "{storage}");
            let (plain, coded) = (number(of("f32", count), "psnr"), number(of(tokens, count), "psnr"));
            assert!((plain - coded).abs() < 1.5, "{tokens}, {count}: {coded} dB, {plain} without rounding");
        }
        assert!(number(of(tokens, 8), "scene_bytes") < 0.5 * number(of("f32", 8), "scene_bytes"));
    }
    assert!(number(of("coded-1", 8), "scene_bytes") < number(of("coded", 8), "scene_bytes"));
    assert!(points.iter().all(|point| point["method"] == "clift" || point["tokens"] != "coded"));
    place.clift("render DIR/room.clift --path orbit --frames 2 -o DIR/out").ok();
}

#[test]
fn codecs_are_fitted_again_alike_and_models_without_one_have_a_remedy() {
    let place = Place::with(&WHOLE);
    let codec = place.bytes(CODEC);
    place.clift("codec DIR/run").fails_with(2, &["codec.safetensors exists", "--force"]);
    place.clift("codec DIR/run --force").ok().prints("fitted on 8 scenes\n");
    assert_eq!(place.bytes(CODEC), codec, "equal weights and scenes give equal codecs");
    // Training goes on where it was killed: after the weights, before the codec.
    std::fs::remove_file(place.at(CODEC)).unwrap();
    std::fs::remove_dir_all(place.at("run/eval")).unwrap();
    encode(&place, "--format coded").fails_with(2, &["no token codec at ", "fit it with `clift codec"]);
    place
        .eval("run --format coded --out DIR/none")
        .fails_with(2, &["`eval.formats` = coded: the model has no token codec"]);
    place.eval("run --preset main --out DIR/main").ok().notes("coded tokens are left out");
    place.train("run", &[]).ok();
    assert_eq!(place.bytes(CODEC), codec);
    // A codec of other weights.
    let mut other = TokenCodec::read(&place.at(CODEC)).unwrap();
    other.renderer_hash = "0".repeat(64);
    other.write(&place.at(CODEC)).unwrap();
    encode(&place, "--format coded").fails_with(1, &["the codec was fitted to other weights; fit it again"]);

    let place = Place::with(&STAGE_1);
    assert!(!place.at("run/stage1/codec.safetensors").exists());
    place.clift("codec DIR/run").ok();
    encode(&place, "--format coded").ok().prints("(kmeans, coded");
    place.clift("render DIR/room.clift --path orbit --frames 2 -o DIR/out").ok();
}

#[test]
fn scenes_of_a_replaced_codec_are_refused() {
    let place = Place::with(&WHOLE);
    encode(&place, "--format coded-0").fails(2);
    encode(&place, "--format coded").ok();
    place.clift("codec DIR/run --force --set eval.stored_tokens=[0.5]").ok();
    let expected = ["the scene was coded with the codec ", "give the run it was encoded with"];
    place.clift("render DIR/room.clift --path orbit --frames 2 -o DIR/again").fails_with(1, &expected);
}
