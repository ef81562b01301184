//! Published checkpoints through the command line.

use std::collections::BTreeSet;
use std::path::Path;

use clift_data::{StateDict, write_state_dict};

use crate::support::{Place, list, number, point, repository};

/// Images of 2 x 3 patches: the fixtures' networks accept any size.
const SMALL: &str = "--set data.width=24 --set data.height=16 --set eval.num_sheets=1";

const DATA: &str = "--data REPO/data-fixtures/re10k-mini";
const INDEX: &str = "--index REPO/data-fixtures/re10k-mini/evaluation_index.json";

fn checkpoint(name: &str) -> String {
    format!("REPO/data-fixtures/checkpoints/{name}.ckpt")
}

/// Imports a fixture into the folder `name` and returns its path in [`Place::clift`].
fn import(place: &Place, file: &str, variant: &str, num_heads: &str, name: &str) -> String {
    let words = format!("import {file} --variant {variant} --num-heads {num_heads} -o DIR/{name}");
    place.clift(&words).ok().prints("transformer.output_norm.weight -> renderer.output_norm.weight");
    format!("DIR/{name}")
}

/// Writes the network of a fixture before its second stage: another renderer, no condenser.
pub fn write_first_stage(path: &Path) {
    let state = StateDict::open(&repository("data-fixtures/checkpoints/re10k.ckpt")).unwrap();
    let keys = state.keys().filter(|key| key.starts_with("transformer.") && !key.contains("squeezer"));
    let tensors = keys.map(|key| {
        let factor = if key.contains("patch_to_image") { 0.9 } else { 1.0 };
        let values = state.read(key).unwrap().into_iter().map(|value| value * factor).collect();
        let shape = state.tensor(key).unwrap().1.iter().map(|&size| size as usize).collect();
        (key.to_owned(), shape, values)
    });
    write_state_dict(path, &tensors.collect::<Vec<_>>()).unwrap();
}

/// Evaluates a model on the test scene of the small data set.
fn evaluate(place: &Place, model: &str, out: &str, flags: &str) -> serde_json::Value {
    place.clift(&format!("eval --checkpoint {model} {DATA} {INDEX} --out DIR/{out} --force {SMALL} {flags}")).ok();
    place.json(&format!("{out}/summary.json"))
}

fn variants(summary: &serde_json::Value) -> BTreeSet<&str> {
    list(&summary["points"]).iter().map(|point| point["method"].as_str().unwrap()).collect()
}

#[test]
fn published_checkpoints_import_evaluate_encode_and_render() {
    let place = Place::new();
    for (name, variant, heads) in [("re10k", "released-re10k", "3"), ("dl3dv", "released-dl3dv", "7")] {
        let model = import(&place, &checkpoint(name), variant, heads, name);
        let config = place.text(&format!("{name}/config.toml"));
        let poses = if name == "re10k" { ["\"quaternion\"", "\"all\""] } else { ["\"axes\"", "\"context\""] };
        for line in [
            format!("variant = \"{variant}\""),
            format!("pose_rotation = {}", poses[0]),
            format!("pose_scale = {}", poses[1]),
        ] {
            assert!(config.contains(&line), "{line}\nis not in\n{config}");
        }
        // As for a network that was trained on small images.
        let small = config
            .replace("width = 256", "width = 24")
            .replace("width = 448", "width = 24")
            .replace("height = 256", "height = 16");
        place.write(&format!("{name}/config.toml"), small);
        let summary = evaluate(&place, &model, &format!("{name}-eval"), "");
        assert_eq!((&summary["num_scenes"], &summary["num_views"]), (&1.into(), &4.into()));
        assert_eq!(variants(&summary), ["clift"].into());
        // The reference's shares of 24 tokens.
        let stored: Vec<_> = list(&summary["points"]).iter().map(|point| &point["num_storage_tokens"]).collect();
        assert_eq!(stored, [1, 3, 6, 12, 18, 24]);
        let data = "REPO/data-fixtures/re10k-mini --scene 00000000000000b1";
        place.clift(&format!("encode {model} {data} -o DIR/{name}.clift --stored-tokens 1/2")).ok();
        place.clift(&format!("render DIR/{name}.clift --path interpolate --frames 3 -o DIR/{name}-frames")).ok();
        assert!(place.at(&format!("{name}-frames/frame-00002.png")).exists());
    }
}

#[test]
fn a_first_stage_model_adds_the_uncondensed_variants() {
    let place = Place::new();
    let model = import(&place, &checkpoint("re10k"), "released-re10k", "3", "second");
    write_first_stage(&place.at("first.ckpt"));
    let first = import(&place, "DIR/first.ckpt", "released-re10k", "3", "first");
    assert_eq!(variants(&evaluate(&place, &first, "a", "")), ["kmeans", "random"].into());
    let alone = evaluate(&place, &first, "a", "--stored-tokens 6");
    let both = evaluate(&place, &model, "b", &format!("--stage1 {first} --stored-tokens 6"));
    assert_eq!(variants(&both), ["clift", "kmeans", "random"].into());
    let psnr = |summary: &serde_json::Value| number(point(list(&summary["points"]), "kmeans", 6), "psnr");
    assert_eq!(psnr(&alone), psnr(&both), "the first stage's own renderer draws them");
    let other = import(&place, &checkpoint("re10k_first"), "released-re10k", "5", "other");
    place
        .clift(&format!("eval --checkpoint {model} --stage1 {other} {DATA} --out DIR/c {SMALL}"))
        .fails_with(2, &["model.num_heads"]);
}

#[test]
fn released_variants_train() {
    let place = Place::new();
    for variant in ["released-re10k", "released-dl3dv"] {
        let set = [&format!("model.variant={variant}")[..], "checkpoint.every=2"];
        place.train(variant, &set).ok();
        let [first, second] = ["stage1", "stage2"].map(|stage| place.weights(variant, stage));
        let moved = |part: &str| {
            let (second, first) = (second.part(part), first.part(part));
            second.moved_from(&first).fold(0.0, f64::max)
        };
        assert_eq!(moved("encoder."), 0.0, "the encoder is frozen in stage 2");
        assert!(moved("renderer.") > 0.0);
        assert!(second.part("condenser.released.gate.").0.values().flatten().any(|&value| value != 0.0));
        if variant == "released-dl3dv" {
            // Four steps of AdamW at up to 1e-3 move every value by about the sum of the rates, the renderer's by a tenth.
            assert!(moved("lift_norm.") > 3.0 * moved("renderer.output_norm."), "it trains at the full rate");
        }
        let state = place.json(&format!("{variant}/stage2/checkpoints/step-000000004/state.json"));
        assert_eq!(state["model"]["variant"], *variant, "saved with every checkpoint");
        let points = place.json(&format!("{variant}/eval/summary.json"));
        assert_eq!(variants(&points), ["clift", "kmeans", "random"].into());
    }
}

#[test]
fn dl3dv_starts_from_re10k_and_lists_new_parameters() {
    let place = Place::new();
    import(&place, &checkpoint("re10k"), "released-re10k", "3", "re10k");
    let model = "model={variant='released-dl3dv', dim=15, num_heads=3, feed_forward_dim=22, num_encoder_blocks=1, \
                 num_renderer_blocks=2}";
    let set = [model, &format!("stage1.init_from={:?}", place.at("re10k")), "stage1.steps=0"];
    let ran = place.train("dl3dv --only stage1", &set).ok();
    let (old, new) = (place.model("re10k"), place.weights("dl3dv", "stage1"));
    let added: Vec<&String> = new.0.keys().filter(|name| !old.0.contains_key(*name)).collect();
    assert_eq!(added.len(), 12, "queries and keys of five attention layers, weight and bias of a norm: {added:?}");
    ran.notes("initialized, not in the file: 12 (encoder.blocks.0.attn.qk_norm.key.weight, ")
        .notes("lift_norm.norm.bias, ..); unused in the file: 22 (condenser.released.");
    for (name, values) in old.0.iter().filter(|(name, _)| !name.starts_with("condenser.")) {
        assert_eq!(&new.0[name], values, "{name}");
    }
    let gamma: Vec<f32> = new.part("lift_norm.norm.weight").0.into_values().flatten().collect();
    assert_eq!(gamma, [1.0; 15]);
}
