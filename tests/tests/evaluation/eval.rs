//! Evaluations through the command line: formats, Pareto fronts, external methods, LPIPS, comparisons, counts.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use safetensors::Dtype;
use safetensors::tensor::TensorView;

use crate::support::{Place, STAGE_1, WHOLE, list, number};

const WIDTHS: [usize; 5] = [64, 128, 256, 512, 512];

/// Scene and target frame of every measured view.
fn views(place: &Place, folder: &str) -> Vec<(String, String)> {
    let text = place.text(&format!("{folder}/views.csv"));
    let views = text.lines().skip(1).map(|line| {
        let mut cells = line.split(',').map(str::to_owned);
        (cells.next().expect("a scene"), cells.next().expect("a frame"))
    });
    let views: std::collections::BTreeSet<_> = views.collect();
    views.into_iter().collect()
}

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
fn every_format_and_count_has_speed_and_fronts() {
    let place = Place::with(&WHOLE);
    let ran = place.eval("run --format f32,f16,int8 --render 1/2 --out DIR/formats").ok();
    ran.prints("t: no other point has a higher PSNR");
    let points = place.points("formats");
    let of = |variant: &str, format: &str| {
        points.iter().filter(move |point| point["method"] == variant && point["tokens"] == format).count()
    };
    for format in ["f32", "f16", "int8"] {
        // 8 and 4 of 8, 4 and 2 of 4.
        assert_eq!((of("clift", format), of("kmeans", format)), (4, 4), "{format}");
    }
    assert_eq!((of("random", "f32"), of("random", "int8")), (4, 0), "random subsets have no file to be rounded in");
    for point in &points {
        let number = |key: &str| number(point, key);
        assert!(number("render_p95_s") >= number("render_median_s") && number("render_median_s") > 0.0, "{point}");
        assert!(number("frame_median_s") >= number("render_median_s"), "{point}");
        assert!(number("gflops") > 0.0 && number("num_views") == 6.0, "{point}");
        // Null on systems that do not report it; a process takes more than a mebibyte.
        assert!(point["peak_bytes"].is_null() || number("peak_bytes") > 1e6, "{point}");
    }
    for front in ["pareto_time", "pareto_bytes"] {
        assert!(points.iter().any(|point| point[front] == true), "{front}");
        assert!(points.iter().any(|point| point[front] == false), "{front}");
    }
    // The highest PSNR is on the front of time, whatever it takes.
    let best = points.iter().max_by(|a, b| number(a, "psnr").total_cmp(&number(b, "psnr"))).unwrap();
    let ties = points.iter().filter(|point| point["psnr"] == best["psnr"]);
    assert_eq!(ties.filter(|point| point["pareto_time"] == true).count(), 1);
    let html = place.text("formats/report.html");
    assert!(html.contains("clift, int8") && html.contains("front:<br>bytes"));
    // 3 scenes, of 20 + 8 settings and 2 baselines.
    assert_eq!(place.text("formats/scenes.csv").lines().count(), 1 + 3 * (points.len() + 2));
}

#[test]
fn predictions_are_scored_and_missing_images_named() {
    let place = Place::with(&STAGE_1);
    place.eval("run").ok();
    let views = views(&place, "run/eval");
    assert_eq!(views.len(), 6);
    let picture = image::RgbImage::from_pixel(16, 16, image::Rgb([128; 3]));
    for (i, (scene, frame)) in views.iter().enumerate().skip(1) {
        // Both layouts.
        let folder = place.at("grey").join(scene).join(if i % 2 == 0 { "color" } else { "" });
        std::fs::create_dir_all(&folder).unwrap();
        picture.save(folder.join(format!("{frame:0>6}.png"))).unwrap();
    }
    let ran = place.eval("run --predictions DIR/grey --name Grey&co --data-size 1.5kB").ok();
    let missing = format!("{}/{:0>6}.png", views[0].0, views[0].1);
    ran.prints("Grey&co: 1 of 6 images are missing").prints(&missing);
    let summary = place.json("run/eval/summary.json");
    assert_eq!(summary["missing"][0]["images"], serde_json::json!([missing]));
    let point = list(&summary["points"]).iter().find(|point| point["method"] == "Grey&co").unwrap();
    assert_eq!((&point["num_views"], &point["scene_bytes"]), (&5.into(), &1500.into()));
    assert!((5.0..40.0).contains(&number(point, "psnr")), "{point}");
    assert!(place.text("run/eval/report.html").contains("Grey&amp;co"));
    assert_eq!(place.text("run/eval/views.csv").matches(",Grey&co,0,0,").count(), 5);

    // Another size, no image at all, a reserved name, more names than folders.
    let (scene, frame) = &views[1];
    let small = place.at("small").join(scene);
    std::fs::create_dir_all(&small).unwrap();
    image::RgbImage::new(8, 16).save(small.join(format!("{frame:0>6}.png"))).unwrap();
    std::fs::create_dir_all(place.at("empty")).unwrap();
    for (flags, code, expected) in [
        ("DIR/small", 1, "8 x 16 pixels, expected 16 x 16 like the target"),
        ("DIR/empty", 2, "empty has none of the 6 target images, such as synthetic-0-test-"),
        ("DIR/grey --name clift", 2, "reserved for a method of clift"),
        ("DIR/grey --name a --name b", 2, "1 --predictions but 2 --name"),
        ("no/such/folder", 2, "no/such/folder"),
    ] {
        place.eval(&format!("run --predictions {flags}")).fails_with(code, &[expected]);
    }
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

    // The wrong file, and none where one is named.
    write_vgg(&place.at("other.safetensors"), "clift-vgg19-1", [2, 2, 4, 4, 2], false);
    place
        .eval("run --set eval.lpips_weights=\"DIR/other.safetensors\"")
        .fails_with(2, &["format clift-vgg19-1, expected", "convert_vgg.py lpips"]);
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
    // The same updates, computed again; the same losses to the last digit of f32.
    place.train("again", &[&set[..], &["activation_checkpointing=true"]].concat()).ok();
    place.assert_same_result("again", "run");
    // The term changes the weights.
    place.train("plain", &short).ok();
    assert!(place.weights("plain", "stage1") != place.weights("run", "stage1"));
    assert!(place.weights("plain", "stage2").part("condenser.") != place.weights("run", "stage2").part("condenser."));
}

#[test]
fn two_evaluations_are_compared_pair_by_pair() {
    let place = Place::new();
    place.copy(&WHOLE, "a");
    place.train("b", &["seed=1", "stage1.steps=8"]).ok();
    let ran = place.clift("compare DIR/a DIR/b --json DIR/difference.json").ok();
    ran.prints("clift 8 f32").prints("random 4 f32");
    let comparison = place.json("difference.json");
    let pairs = list(&comparison["pairs"]);
    // Six settings and the two baselines, whose images do not depend on the weights.
    assert_eq!(pairs.len(), 8);
    for pair in pairs {
        assert_eq!((&pair["num_scenes"], &pair["num_only_a"]), (&3.into(), &0.into()), "{pair}");
        let of_pair = |key: &str| number(&pair["psnr"], key);
        assert!((of_pair("b") - of_pair("a") - of_pair("mean")).abs() < 1e-9, "{pair}");
        if pair["a"]["num_storage_tokens"] == 0 {
            assert_eq!(of_pair("mean"), 0.0);
            continue;
        }
        for run in ["a", "b"] {
            let points = place.points(&format!("{run}/eval"));
            let keys = ["method", "num_storage_tokens", "num_render_tokens"];
            let point = points.iter().find(|point| keys.iter().all(|key| point[key] == pair["a"][key]));
            let psnr = number(point.unwrap(), "psnr");
            assert!((psnr - of_pair(run)).abs() < 1e-9, "the mean over scenes of the summary");
        }
    }
    place.clift("compare DIR/a no/such/run").fails_with(2, &["no/such/run", "no such file or folder"]);
    place.clift("compare DIR/a DIR/a/stage1").fails_with(2, &["no views.csv here or in `eval`; `clift eval` writes"]);
}

#[test]
fn the_papers_counts_come_out_of_the_command() {
    let place = Place::new();
    let ran = place.clift("flops --convention paper").ok();
    ran.prints("render  4096    70.59").prints("render  512     45.23");
    place.clift("flops REPO/configs/tiny.toml --render 16,1.0 --json DIR/flops.json").ok();
    let counts = place.json("flops.json");
    assert_eq!((&counts["convention"], &counts["num_tokens"]), (&"macs".into(), &256.into()));
    let rendered = list(&counts["rows"]).iter().filter(|row| row["work"] == "render");
    assert_eq!(rendered.map(|row| &row["num_tokens"]).collect::<Vec<_>>(), [16, 256]);
    place.clift("flops REPO/configs/re10k.toml").ok().prints("4 context views, 4096 tokens");
    place.clift("flops --convention flop").fails_with(2, &["flop"]);
    place.clift("flops --render 5000").fails_with(2, &["a scene has 4096 tokens"]);
}
