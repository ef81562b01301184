//! Evaluations through the command line: formats, Pareto fronts, external methods, LPIPS, comparisons, counts.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use safetensors::Dtype;
use safetensors::tensor::TensorView;
use serde_json::Value;

use crate::support::{Place, STAGE_1, WHOLE, clift, repository};

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
fn write_vgg(path: &Path, format: &str, convs: [usize; 5], has_heads: bool) {
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

fn points(place: &Place, folder: &str) -> Vec<Value> {
    place.json(&format!("{folder}/summary.json"))["points"].as_array().expect("a list").clone()
}

#[test]
fn every_format_and_count_has_speed_and_fronts() {
    let place = Place::new();
    place.copy(&WHOLE, "run");
    let out = place.at("formats");
    let flags = ["--tokens", "f32,f16,int8", "--render", "1/2", "--out", out.to_str().unwrap()];
    let ran = place.eval("run", &flags).ok();
    assert!(ran.stdout.contains("t: no other point has this PSNR"), "{}", ran.stdout);
    let points = points(&place, "formats");
    let of = |variant: &str, format: &str| {
        points.iter().filter(move |point| point["variant"] == variant && point["tokens"] == format).count()
    };
    for format in ["f32", "f16", "int8"] {
        // 8 and 4 of 8, 4 and 2 of 4.
        assert_eq!((of("clift", format), of("kmeans", format)), (4, 4), "{format}");
    }
    assert_eq!((of("random", "f32"), of("random", "int8")), (4, 0), "random subsets have no file to be rounded in");
    for point in &points {
        let number = |key: &str| point[key].as_f64().unwrap_or_else(|| panic!("{key}: {point}"));
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
    let best = points.iter().max_by(|a, b| a["psnr"].as_f64().partial_cmp(&b["psnr"].as_f64()).unwrap()).unwrap();
    let ties = points.iter().filter(|point| point["psnr"] == best["psnr"]);
    assert_eq!(ties.filter(|point| point["pareto_time"] == true).count(), 1);
    let html = place.text("formats/report.html");
    assert!(html.contains("clift, int8") && html.contains("front:<br>bytes"));
    // 3 scenes, of 20 + 8 settings and 2 baselines.
    assert_eq!(place.text("formats/scenes.csv").lines().count(), 1 + 3 * (points.len() + 2));
}

#[test]
fn predictions_are_scored_and_missing_images_named() {
    let place = Place::new();
    place.copy(&STAGE_1, "run");
    place.eval("run", &[]).ok();
    let views = views(&place, "run/eval");
    assert_eq!(views.len(), 6);
    let picture = image::RgbImage::from_pixel(16, 16, image::Rgb([128; 3]));
    for (i, (scene, frame)) in views.iter().enumerate().skip(1) {
        // Both layouts.
        let folder = place.at("grey").join(scene).join(if i % 2 == 0 { "color" } else { "" });
        std::fs::create_dir_all(&folder).unwrap();
        picture.save(folder.join(format!("{frame:0>6}.png"))).unwrap();
    }
    let grey = place.at("grey").display().to_string();
    let flags = ["--predictions", &grey, "--name", "Grey & co", "--data-size", "1.5kB"];
    let ran = place.eval("run", &flags).ok();
    let missing = format!("{}/{:0>6}.png", views[0].0, views[0].1);
    assert!(ran.stdout.contains("Grey & co: 1 of 6 images are missing"), "{}", ran.stdout);
    assert!(ran.stdout.contains(&missing), "{}", ran.stdout);
    let summary = place.json("run/eval/summary.json");
    assert_eq!(summary["missing"][0]["pictures"], serde_json::json!([missing]));
    let point = summary["points"].as_array().unwrap().iter().find(|point| point["variant"] == "Grey & co").unwrap();
    assert_eq!((&point["num_views"], &point["scene_bytes"]), (&5.into(), &1500.into()));
    assert!(point["psnr"].as_f64().is_some_and(|psnr| psnr > 5.0 && psnr < 40.0), "{point}");
    assert!(place.text("run/eval/report.html").contains("Grey &amp; co"));
    assert_eq!(place.text("run/eval/views.csv").matches(",Grey & co,0,0,").count(), 5);

    // Another size, no image at all, a reserved name, more names than folders.
    let (scene, frame) = &views[1];
    let small = place.at("small").join(scene);
    std::fs::create_dir_all(&small).unwrap();
    image::RgbImage::new(8, 16).save(small.join(format!("{frame:0>6}.png"))).unwrap();
    let small = place.at("small").display().to_string();
    place.eval("run", &["--predictions", &small]).fails_with(1, &["8 x 16 pixels, expected 16 x 16 like the target"]);
    let empty = place.at("empty");
    std::fs::create_dir_all(&empty).unwrap();
    let empty = empty.display().to_string();
    place
        .eval("run", &["--predictions", &empty])
        .fails_with(2, &["empty has none of the 6 target images, such as synthetic-0-test-"]);
    place.eval("run", &["--predictions", &grey, "--name", "clift"]).fails_with(2, &["reserved for a method of clift"]);
    let two = ["--predictions", &grey, "--name", "a", "--name", "b"];
    place.eval("run", &two).fails_with(2, &["1 --predictions but 2 --name"]);
    place.eval("run", &["--predictions", "no/such/folder"]).fails_with(2, &["no/such/folder"]);
}

#[test]
fn lpips_needs_its_weights() {
    let place = Place::new();
    place.copy(&STAGE_1, "run");
    let ran = place.eval("run", &[]).ok();
    assert!(
        ran.stdout.contains("lpips_vgg is not measured: eval.lpips_weights is not set; make the file with `python3"),
        "{}",
        ran.stdout
    );
    let summary = place.json("run/eval/summary.json");
    assert_eq!(summary["not_measured"][0]["metric"], "lpips_vgg");
    assert!(summary["points"][0]["lpips_vgg"].is_null() && summary["lpips_weights_sha256"].is_null());

    let file = place.at("lpips.safetensors");
    write_vgg(&file, "clift-lpips-vgg-1", [2, 2, 3, 3, 3], true);
    let set = format!("eval.lpips_weights={file:?}");
    let ran = place.eval("run", &["--set", &set]).ok();
    assert!(!ran.stdout.contains("not measured"), "{}", ran.stdout);
    let summary = place.json("run/eval/summary.json");
    let sha256 = summary["lpips_weights_sha256"].as_str().expect("a hash");
    assert!(ran.stderr.contains(&format!("LPIPS: weights with SHA-256 {sha256}")), "{}", ran.stderr);
    for point in summary["points"].as_array().unwrap() {
        let lpips = point["lpips_vgg"].as_f64().unwrap_or_else(|| panic!("{point}"));
        assert!(lpips > 0.0 && lpips < 10.0, "{point}");
        // As many views in every scene.
        assert!((lpips - point["lpips_vgg_per_view"].as_f64().unwrap()).abs() < 1e-12, "{point}");
    }
    assert!(summary["baselines"]["nearest_view"]["lpips_vgg"].as_f64().is_some_and(|lpips| lpips > 0.0));

    // The wrong file, and none where one is named.
    let other = place.at("other.safetensors");
    write_vgg(&other, "clift-vgg19-1", [2, 2, 4, 4, 2], false);
    place
        .eval("run", &["--set", &format!("eval.lpips_weights={other:?}")])
        .fails_with(2, &["format clift-vgg19-1, expected", "convert_vgg.py lpips"]);
    let set = ["eval.lpips_weights=\"no/such/file\""];
    place.train("new", &set, &[]).fails_with(2, &["`eval.lpips_weights` = no/such/file: file not found"]);
}

#[test]
fn the_perceptual_loss_trains_both_stages() {
    let place = Place::new();
    let weight = "loss.perceptual_weight=0.5";
    place.train("run", &[weight], &[]).fails_with(2, &["`loss.vgg_weights` = missing", "convert_vgg.py vgg19"]);
    assert!(!place.at("run").exists(), "nothing is begun");

    let file = place.at("vgg19.safetensors");
    write_vgg(&file, "clift-vgg19-1", [2, 2, 4, 4, 2], false);
    let file = format!("loss.vgg_weights={file:?}");
    let ran = place.train("run", &[weight, &file], &[]).ok();
    assert!(ran.stderr.contains("perceptual loss: weights with SHA-256 "), "{}", ran.stderr);
    for line in place.metrics("run") {
        let number = |key: &str| line[key].as_f64().unwrap_or_else(|| panic!("{key}: {line}"));
        let mse = 10_f64.powf(number("psnr") / -10.0);
        assert!(number("loss") > mse, "PSNR is of the squared error alone: {line}");
    }
    // The same updates, computed again; the same losses to the last digit of f32.
    place.train("again", &[weight, &file, "activation_checkpointing=true"], &[]).ok();
    place.assert_same_result("again", "run");
    // The term changes the weights.
    place.copy(&WHOLE, "plain");
    assert!(place.weights("plain", "stage1") != place.weights("run", "stage1"));
    assert!(place.weights("plain", "stage2").part("condenser.") != place.weights("run", "stage2").part("condenser."));
}

#[test]
fn two_evaluations_are_compared_pair_by_pair() {
    let place = Place::new();
    place.copy(&WHOLE, "a");
    place.train("b", &["seed=1", "stage1.steps=8"], &[]).ok();
    let (a, b) = (place.at("a").display().to_string(), place.at("b").display().to_string());
    let json = place.at("difference.json").display().to_string();
    let ran = clift(["compare", &a, &b, "--json", &json]).ok();
    assert!(ran.stdout.contains("clift 8 f32") && ran.stdout.contains("random 4 f32"), "{}", ran.stdout);
    let comparison = place.json("difference.json");
    let pairs = comparison["pairs"].as_array().unwrap();
    // Six settings and the two baselines, whose images do not depend on the weights.
    assert_eq!(pairs.len(), 8);
    let points = |run: &str| points(&place, &format!("{run}/eval"));
    for pair in pairs {
        assert_eq!((&pair["num_scenes"], &pair["num_only_a"]), (&3.into(), &0.into()), "{pair}");
        let number = |key: &str| pair["psnr"][key].as_f64().unwrap();
        assert!((number("b") - number("a") - number("mean")).abs() < 1e-9, "{pair}");
        if pair["a"]["num_storage_tokens"] == 0 {
            assert_eq!(number("mean"), 0.0);
            continue;
        }
        for (run, side) in [("a", "a"), ("b", "b")] {
            let points = points(run);
            let point = points.iter().find(|point| {
                ["variant", "num_storage_tokens", "num_render_tokens"].iter().all(|key| point[key] == pair["a"][key])
            });
            let psnr = point.unwrap()["psnr"].as_f64().unwrap();
            assert!((psnr - number(side)).abs() < 1e-9, "the mean over scenes of the summary");
        }
    }
    // One variant against another, and evaluations of other scenes.
    let ran = clift(["compare", &a, &a, "--methods", "random,kmeans"]).ok();
    assert!(ran.stdout.contains("random 4 f32 -> kmeans 4 f32"), "{}", ran.stdout);
    let out = place.at("fewer");
    place.eval("b", &["--set", "eval.num_scenes=2", "--out", out.to_str().unwrap()]).ok();
    let ran = clift(["compare", &a, out.to_str().unwrap()]).ok();
    assert!(
        ran.stdout.contains("4 common views are compared, up to 2 views of A and 0 views of B are ignored"),
        "{}",
        ran.stdout
    );
    clift(["compare", &a, "no/such/run"]).fails_with(2, &["no views.csv here or in `eval`", "no/such/run"]);
}

#[test]
fn the_papers_counts_come_out_of_the_command() {
    let ran = clift(["flops", "--convention", "paper"]).ok();
    for row in ["render  4096    70.59", "render  512     45.23"] {
        assert!(ran.stdout.contains(row), "{}", ran.stdout);
    }
    let place = Place::new();
    let json = place.at("flops.json").display().to_string();
    let config = repository("configs/tiny.toml").display().to_string();
    clift(["flops", &config, "--render", "16,1.0", "--json", &json]).ok();
    let counts = place.json("flops.json");
    assert_eq!((&counts["convention"], &counts["num_tokens"]), (&"macs".into(), &64.into()));
    let rendered: Vec<&Value> =
        counts["rows"].as_array().unwrap().iter().filter(|row| row["work"] == "render").collect();
    assert_eq!(rendered.iter().map(|row| &row["num_tokens"]).collect::<Vec<_>>(), [16, 64]);
    clift(["flops", "--convention", "flop"]).fails_with(2, &["flop"]);
    clift(["flops", "--render", "5000"]).fails_with(2, &["a scene has 4096 tokens"]);
}
