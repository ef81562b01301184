//! Evaluations and trainings with VGG networks: LPIPS and the perceptual loss.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use safetensors::Dtype;
use safetensors::tensor::TensorView;

use crate::support::{Place, STAGE_1, list, number};

const WIDTHS: [usize; 5] = [64, 128, 256, 512, 512];

/// Writes a file in the form of `scripts/tools/convert_vgg.py`, with small random weights.
pub fn write_vgg(path: &Path, format: &str, convs: [usize; 5], has_heads: bool) {
    let mut state = 1_u32;
    let mut random = |count: usize, scale: f32| -> Vec<u8> {
        let mut value = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / 8_388_608.0 - 1.0
        };
        (0..count).flat_map(|_| (value() * scale).to_le_bytes()).collect()
    };
    let mut tensors: BTreeMap<String, (Vec<usize>, Vec<u8>)> = BTreeMap::new();
    let mut inputs = 3;
    for (stage, (&count, &outputs)) in convs.iter().zip(&WIDTHS).enumerate() {
        for i in 1..=count {
            let name = format!("conv{}_{i}", stage + 1);
            // Uniform with the variance 2 / fan-in keeps activations where they are.
            let scale = (6.0 / (9 * inputs) as f32).sqrt();
            let weight = random(outputs * inputs * 9, scale);
            tensors.insert(format!("{name}.weight"), (vec![outputs, inputs, 3, 3], weight));
            tensors.insert(format!("{name}.bias"), (vec![outputs], random(outputs, 0.05)));
            inputs = outputs;
        }
        if has_heads {
            let ones: Vec<u8> = (0..outputs).flat_map(|_| 0.1_f32.to_le_bytes()).collect();
            tensors.insert(format!("head{}.weight", stage + 1), (vec![outputs], ones));
        }
    }
    let tensors = tensors.iter().map(|(name, (shape, bytes))| {
        (name.as_str(), TensorView::new(Dtype::F32, shape.clone(), bytes).expect("as many values as the shape says"))
    });
    let metadata = HashMap::from([("format".to_owned(), format.to_owned())]);
    std::fs::write(path, safetensors::serialize(tensors, Some(metadata)).expect("serialises")).expect("writable");
}

#[test]
fn lpips_needs_its_weights() {
    let place = Place::with(&STAGE_1);
    let missing = "lpips_vgg is not measured: eval.lpips_weights is not set; make the file with `python3";
    place.eval("run").ok().prints(missing);
    let summary = place.json("run/eval/summary.json");
    assert_eq!(summary["not_measured"][0]["metric"], "lpips_vgg");
    assert!(summary["points"][0]["lpips_vgg"].is_null() && summary["lpips_weights_sha256"].is_null());
    write_vgg(&place.at("lpips.safetensors"), "clift-lpips-vgg-1", [2, 2, 3, 3, 3], true);
    let ran = place.eval("run --set eval.num_scenes=1 --set eval.lpips_weights=\"DIR/lpips.safetensors\"").ok();
    assert!(!ran.stdout.contains("not measured"), "{}", ran.stdout);
    let summary = place.json("run/eval/summary.json");
    let sha256 = summary["lpips_weights_sha256"].as_str().expect("a hash");
    ran.notes(&format!("LPIPS: weights with SHA-256 {sha256}"));
    for point in list(&summary["points"]) {
        let lpips = number(point, "lpips_vgg");
        assert!(lpips > 0.0 && lpips < 10.0, "{point}");
        // As many views in every scene.
        assert!((lpips - number(point, "lpips_vgg_per_view")).abs() < 1e-12, "{point}");
    }
    assert!(number(&summary["baselines"]["nearest_view"], "lpips_vgg") > 0.0);

    let set = ["eval.lpips_weights=\"no/such/file\""];
    place.train("new", &set).fails_with(2, &["`eval.lpips_weights` = no/such/file: file not found"]);
}

#[test]
fn the_perceptual_loss_trains_both_stages() {
    let place = Place::new();
    // VGG-19 in full width takes most of the time.
    let short = ["stage1.steps=2", "stage2.steps=3", "eval.num_scenes=1"];
    let weight = "loss.perceptual_weight=0.5";
    place.train("run", &[weight]).fails_with(2, &["`loss.vgg_weights` = missing", "convert_vgg.py vgg19"]);
    let missing = [weight, "loss.vgg_weights=\"no/such/file\""];
    place.train("run", &missing).fails_with(2, &["`loss.vgg_weights` = no/such/file: file not found"]);
    assert!(!place.at("run").exists(), "nothing is begun");
    let file = place.at("vgg19.safetensors");
    write_vgg(&file, "clift-vgg19-1", [2, 2, 4, 4, 2], false);
    let file = format!("loss.vgg_weights={file:?}");
    let set = [&short[..], &[weight, &file]].concat();
    place.train("run", &set).ok().notes("perceptual loss: weights with SHA-256 ");
    for line in place.metrics("run") {
        let mse = 10_f64.powf(number(&line, "psnr") / -10.0);
        assert!(number(&line, "loss") > mse, "PSNR is of the squared error alone: {line}");
    }
    // The term changes the weights.
    place.train("plain", &short).ok();
    assert!(place.weights("plain", "stage1") != place.weights("run", "stage1"));
    assert!(place.weights("plain", "stage2").part("condenser.") != place.weights("run", "stage2").part("condenser."));
}
