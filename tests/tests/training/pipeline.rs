//! A complete run and every file of its directory.

use crate::support::{Place, STAGE_1, WHOLE, list, number, repository};

#[test]
fn a_run_writes_every_documented_file() {
    let place = Place::new();
    place
        .train("run", &[])
        .ok()
        .prints("nearest_view")
        .prints("clift ")
        .prints("run/eval/report.html\n")
        .prints("\nscenes: clift view ");
    let config = place.text("run/config.toml");
    // Resolved: overrides, and defaults that neither the file nor an override names.
    for line in ["steps = 6", "dim = 16", "max_grad_norm = 1.0", "pose_scale = \"context\""] {
        assert!(config.contains(line), "{line}: {config}");
    }
    assert_eq!(place.json("run/run.json"), serde_json::json!({"version": 3}));

    let lines = place.metrics("run");
    let steps = lines.iter().map(|line| (line["stage"].as_str().unwrap(), line["step"].as_u64().unwrap()));
    let expected = (1..=6).map(|step| ("stage1", step)).chain((1..=4).map(|step| ("stage2", step)));
    assert_eq!(steps.collect::<Vec<_>>(), expected.collect::<Vec<_>>());
    for line in &lines {
        let number = |key: &str| number(line, key);
        assert!(number("loss") > 0.0 && number("grad_norm") > 0.0 && number("step_s") > 0.0, "{line}");
        // Written from the same f64 to the last digit.
        assert!((number("psnr") + 10.0 * number("loss").log10()).abs() < 1e-9, "{line}");
    }
    let validations = place.json_lines("run/validation.jsonl");
    let steps = validations.iter().map(|line| (line["stage"].as_str().unwrap(), line["step"].as_u64().unwrap()));
    let expected = [("stage1", 3), ("stage1", 6), ("stage2", 3), ("stage2", 4)];
    assert_eq!(steps.collect::<Vec<_>>(), expected, "eval.every = 3");
    assert!(validations.iter().all(|line| number(line, "psnr") > 5.0 && line["num_views"] == 2));
    let summary = place.json("run/eval/summary.json");
    assert_eq!(summary["split"], "test");
    assert_eq!(["num_scenes", "num_views", "num_skipped"].map(|key| summary[key].as_u64()), [3, 6, 0].map(Some));
    let points = list(&summary["points"]);
    let settings = points.iter().map(|point| (point["method"].as_str(), point["num_storage_tokens"].as_u64()));
    let expected = ["clift", "kmeans", "random"].map(|variant| [4, 8].map(|count| (Some(variant), Some(count))));
    assert_eq!(settings.collect::<Vec<_>>(), expected.concat());
    for point in points.iter().chain(["mean_image", "nearest_view"].map(|name| &summary["baselines"][name])) {
        assert!(point["psnr"].is_f64() && point["ssim"].is_f64(), "{point}");
    }
    // A header, then 6 views of 6 points and 2 baselines.
    assert_eq!(place.text("run/eval/views.csv").lines().count(), 1 + 6 * 8);
    for (folder, names) in [
        ("eval/sheets", &["synthetic-0-test-00000.png"][..]),
        ("stage1/samples", &["step-000000003.png", "step-000000006.png"]),
        ("stage2/samples", &["step-000000003.png", "step-000000004.png"]),
        // Every 2, the last 2 are kept.
        ("stage1/checkpoints", &["step-000000004", "step-000000006"]),
        ("stage2/checkpoints", &["step-000000002", "step-000000004"]),
    ] {
        assert_eq!(place.names(&format!("run/{folder}")), names, "{folder}");
        for name in names.iter().filter(|_| !folder.ends_with("checkpoints")) {
            let picture = image::open(place.at("run").join(folder).join(name)).expect("a PNG").into_rgb8();
            // Two targets below each other, at least five columns beside each other.
            assert!(picture.width() >= 5 * 16 && picture.height() >= 2 * 16, "{name}: {:?}", picture.dimensions());
            assert!(picture.pixels().any(|pixel| pixel != picture.get_pixel(0, 0)), "{name} is blank");
        }
    }

    let clusters = place.json("run/clusters/index.json");
    assert_eq!(list(&clusters["entries"]).len(), 6);
    let part = |stage: &str, network: &str| place.weights("run", stage).part(network).0.len();
    for network in ["encoder.", "renderer."] {
        assert_eq!(part("stage1", network), part("stage2", network));
    }
    assert!(part("stage2", "condenser.") > 0);
    assert!(place.weights("run", "stage1").0.keys().all(|name| !name.starts_with("condenser.")));
}

#[test]
fn quiet_runs_print_errors_only() {
    let place = Place::new();
    let ran = place.train("quiet --quiet --only stage1", &[]).ok();
    assert!(ran.stderr.is_empty() && ran.stdout.is_empty(), "{} {}", ran.stderr, ran.stdout);
    place.train("quiet -q --only stage1", &["seed=1"]).fails_with(2, &["error: this run was started with other"]);
}

#[test]
fn moved_runs_evaluate_with_other_counts() {
    let place = Place::new();
    place.copy(&WHOLE, "before");
    let summary = place.summary_but_time("before");
    std::fs::rename(place.at("before"), place.at("after")).unwrap();
    let ran = place.eval("after").ok();
    assert!(ran.stdout.trim_end().ends_with("after/eval"), "{}", ran.stdout);
    assert_eq!(place.summary_but_time("after"), summary);
    assert!(!place.at("before").exists(), "nothing is written to where the run was trained");

    place.eval("after --stored-tokens 3,1/2 --set eval.num_scenes=2 --out DIR/elsewhere").ok();
    let other = place.json("elsewhere/summary.json");
    assert_eq!(other["num_scenes"], 2);
    let stored: Vec<_> = list(&other["points"]).iter().map(|point| &point["num_storage_tokens"]).collect();
    assert_eq!(stored, [3, 4, 3, 4, 3, 4]);
    assert_eq!(place.summary_but_time("after"), summary, "--out leaves the run's own results alone");
}

#[test]
fn early_stages_name_what_to_run_first() {
    let place = Place::new();
    for stage in ["stage2", "clusters"] {
        let needs = format!("error: {stage} needs the weights of stage 1, not found at ");
        let fix = "run/stage1/model.safetensors; run `--only stage1` first";
        place.train(&format!("run --only {stage}"), &[]).fails_with(2, &[&needs, fix]);
    }
    place.copy(&STAGE_1, "run");
    place.train("run --only stage2", &[]).fails_with(2, &["error: stage2 needs the cluster cache, not found at "]);
    // Without stage 2 the evaluation measures stage 1 and prints a note.
    let ran = place.eval("run").ok().notes("stage 2 has not run");
    assert!(!ran.stdout.contains("\nclift "), "{}", ran.stdout);

    place.eval("nowhere").fails_with(2, &["no such folder; write the `run_dir` of a `clift train`"]);
}

#[test]
fn runs_start_from_weights_of_other_runs() {
    let place = Place::new();
    place.train("first --only stage1", &["seed=7"]).ok();
    let first = place.at("first").display().to_string();
    let file = place.at("first/stage1/model.safetensors").display().to_string();
    for from in [&first, &file] {
        // No steps: the weights of the second run are those it starts from.
        let set = [&format!("stage1.init_from={from:?}"), "stage1.steps=0"];
        let ran = place.train("second --only stage1 --fresh", &set).ok();
        let count = place.weights("first", "stage1").0.len();
        ran.notes(&format!(
            "loaded {count} parameters from {file}; initialized, not in the file: none; unused in the file: none"
        ));
        assert_eq!(place.weights("second", "stage1"), place.weights("first", "stage1"));
    }

    let set = [&format!("stage1.init_from={first:?}"), "model.dim=8"];
    place.train("third --only stage1", &set).fails_with(2, &["`model.dim` = 8", "a network with 16; "]);
    place.train("fourth", &["stage1.init_from=no/such/run.safetensors"]).fails_with(1, &["no/such/run.safetensors"]);

    // The condenser of a run's stage 2; without one, before stage 1 is trained.
    let from_first = format!("stage2.init_from={first:?}");
    place.train("fifth", &[&from_first]).fails_with(1, &["first/stage2/model.safetensors", "no such file"]);
    assert!(!place.at("fifth/stage1").exists());
    let from_file = format!("stage2.init_from={file:?}");
    place.train("sixth", &[&from_file]).fails_with(1, &["stage2.init_from", "no condenser"]);
    place.train("first", &["seed=7"]).ok();
    place.train("seventh", &[&from_first, "stage2.steps=0"]).ok();
    let condenser = |run: &str| place.weights(run, "stage2").part("condenser.");
    assert_eq!(condenser("seventh"), condenser("first"));
    let other = [&from_first[..], "model.condenser.member_share=true"];
    place.train("eighth", &other).fails_with(2, &["`model.condenser.member_share` = true"]);

    // Two configs of one command.
    let micro = std::fs::read_to_string(repository("tests/micro.toml")).unwrap();
    for (name, from) in [("ninth", "first"), ("tenth", "ninth")] {
        let start = format!("[stage1]\ninit_from = {:?}", place.at(from));
        let config = micro.replace("runs/micro", &place.at(name).display().to_string()).replace("[stage1]", &start);
        std::fs::write(place.at(&format!("{name}.toml")), config).unwrap();
    }
    let from = format!("parameters from {}", place.at("ninth/stage1/model.safetensors").display());
    place.clift("train DIR/ninth.toml DIR/tenth.toml --only stage1").ok().notes(&from);
    place.clift("train DIR/ninth.toml DIR/ninth.toml").fails_with(2, &["the configs have the same run_dir"]);
}
