//! A complete run and every file of its directory.

use std::collections::BTreeMap;

use crate::support::{Place, Ran, STAGE_1, WHOLE, list, number};

#[test]
fn a_run_writes_every_documented_file() {
    let place = Place::new();
    let ran = place
        .train("run", &[])
        .ok()
        .prints("nearest_view")
        .prints("clift ")
        .prints("run/eval/report.html\n")
        .prints("\nscenes: clift view ");
    // What differs from the file is printed.
    ran.notes(&format!("--set run_dir: \"runs/micro\" -> {:?}\n", place.at("run")));
    let config = place.text("run/config.toml");
    // Resolved: overrides, and defaults that neither the file nor an override names.
    for line in ["steps = 6", "dim = 16", "max_grad_norm = 1.0", "crop = \"protocol\""] {
        assert!(config.contains(line), "{line}: {config}");
    }
    assert_eq!(place.json("run/run.json"), serde_json::json!({"version": 2, "overfit": null, "extended": []}));

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
    assert!(lines.is_sorted_by(|a, b| number(a, "time") <= number(b, "time")));
    let validations = place.json_lines("run/validation.jsonl");
    let steps = validations.iter().map(|line| (line["stage"].as_str().unwrap(), line["step"].as_u64().unwrap()));
    let expected = [("stage1", 3), ("stage1", 6), ("stage2", 3), ("stage2", 4)];
    assert_eq!(steps.collect::<Vec<_>>(), expected, "eval.every = 3");
    for line in &validations {
        assert!(number(line, "psnr") > 5.0 && line["num_views"] == 2, "{line}");
    }
    // Warm-up of two steps to 1e-3, then half a cosine to nothing at step 6.
    assert_eq!(lines[1]["lr"], 1e-3);
    assert!(number(&lines[5], "lr") < 1e-18, "{}", lines[5]);

    let summary = place.json("run/eval/summary.json");
    assert_eq!(summary["split"], "test");
    assert_eq!(["num_scenes", "num_views", "num_skipped"].map(|key| summary[key].as_u64()), [3, 6, 0].map(Some));
    for baseline in ["mean_image", "nearest_view"] {
        let baseline = &summary["baselines"][baseline];
        assert!(number(baseline, "psnr") > 5.0 && baseline["ssim"].is_f64(), "{baseline}");
    }
    let points = list(&summary["points"]);
    let settings = points.iter().map(|point| (point["method"].as_str(), point["num_storage_tokens"].as_u64()));
    let expected = ["clift", "kmeans", "random"].map(|variant| [4, 8].map(|count| (Some(variant), Some(count))));
    assert_eq!(settings.collect::<Vec<_>>(), expected.concat());
    for point in points {
        assert_eq!(point["num_render_tokens"], point["num_storage_tokens"]);
        assert!(point["psnr"].is_f64() && point["psnr_stderr"].is_f64() && point["ssim"].is_f64(), "{point}");
    }

    let views = place.text("run/eval/views.csv");
    // A header, then 6 views of 6 points and 2 baselines.
    assert_eq!(views.lines().count(), 1 + 6 * 8, "{views}");
    assert_eq!(place.names("run/eval/sheets"), ["synthetic-0-test-00000.png"], "eval.num_sheets = 1");
    assert_eq!(place.names("run/stage1/samples"), ["step-000000003.png", "step-000000006.png"], "eval.every = 3");
    assert_eq!(place.names("run/stage2/samples"), ["step-000000003.png", "step-000000004.png"]);
    for folder in ["run/eval/sheets", "run/stage1/samples", "run/stage2/samples"] {
        for name in place.names(folder) {
            let path = place.at(folder).join(name);
            let picture = image::open(&path).unwrap_or_else(|error| panic!("{path:?}: {error}")).into_rgb8();
            // Two targets below each other, at least five columns beside each other.
            assert!(picture.width() >= 5 * 16 && picture.height() >= 2 * 16, "{path:?}: {:?}", picture.dimensions());
            let first = picture.get_pixel(0, 0);
            assert!(picture.pixels().any(|pixel| pixel != first), "{path:?} is blank");
        }
    }

    let clusters = place.json("run/clusters/index.json");
    assert_eq!(list(&clusters["entries"]).len(), 6);
    assert_eq!(
        place.names("run/stage1/checkpoints"),
        ["step-000000004", "step-000000006"],
        "every 2, the last 2 are kept"
    );
    assert_eq!(place.names("run/stage2/checkpoints"), ["step-000000002", "step-000000004"]);
    let part = |stage: &str, network: &str| place.weights("run", stage).part(network).0.len();
    for network in ["encoder.", "renderer."] {
        assert_eq!(part("stage1", network), part("stage2", network));
    }
    assert!(part("stage2", "condenser.") > 0);
    assert!(place.weights("run", "stage1").0.keys().all(|name| !name.starts_with("condenser.")));
}

#[test]
fn quiet_and_verbose_runs_print_less_and_more() {
    let place = Place::new();
    let ran = place.train("quiet --quiet --only stage1", &[]).ok();
    assert!(ran.stderr.is_empty() && ran.stdout.is_empty(), "{} {}", ran.stderr, ran.stdout);
    let ran = place.train("verbose -v --only stage1", &[]).ok();
    assert_eq!(ran.stderr.matches(" img/s").count(), 6, "{}", ran.stderr);
    place.train("quiet -q --only stage1", &["seed=1"]).fails_with(2, &["error: this run was started with other"]);
}

#[test]
fn a_new_stage_prints_its_pace_once() {
    let place = Place::new();
    let train = |words: &str, steps: &str| place.train(&format!("run --only stage1{words}"), &[steps]).ok();
    let lines = |ran: &Ran| ran.stderr.lines().filter(|line| line.contains(" per step, ")).map(String::from).collect();
    let first: Vec<String> = lines(&train("", "stage1.steps=25"));
    assert!(first.len() == 1 && first[0].starts_with("stage1: "), "{first:?}");
    assert!(first[0].contains("s left, peak memory so far: "), "{first:?}");
    let resumed: Vec<String> = lines(&train(" --extend", "stage1.steps=50"));
    assert!(resumed.is_empty(), "{resumed:?}");
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
fn stages_run_singly_give_equal_weights() {
    let place = Place::new();
    place.copy(&WHOLE, "whole");
    for stage in ["stage1", "clusters", "stage2"] {
        let ran = place.train(&format!("parts --only {stage}"), &[]).ok();
        assert!(ran.stdout.is_empty(), "a part has no evaluation to print: {}", ran.stdout);
    }
    assert!(!place.at("parts/eval").exists());
    place.assert_same_result("parts", "whole");
    assert_eq!(place.metrics_but_time("parts"), place.metrics_but_time("whole"));
    place.eval("parts").ok();
    let summary = |run: &str| place.summary_but_time(run);
    assert_eq!(summary("parts"), summary("whole"));
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
fn overfitting_one_scene_trains_and_measures_that_scene() {
    let place = Place::new();
    place.train("run --overfit 1", &["stage1.steps=20", "stage2.steps=2"]).ok();
    assert_eq!(place.json("run/run.json")["overfit"], 1);
    let summary = place.json("run/eval/summary.json");
    assert_eq!((&summary["num_scenes"], &summary["num_views"]), (&1.into(), &2.into()));
    let views = place.text("run/eval/views.csv");
    assert!(views.lines().skip(1).all(|line| line.contains("synthetic-0-train-0")), "{views}");
    assert_eq!(list(&place.json("run/clusters/index.json")["entries"]).len(), 1);
    // One scene over and over: the loss of the last five steps is below that of the first five.
    let losses: Vec<f64> = place.metrics("run").iter().map(|line| number(line, "loss")).collect();
    let mean = |losses: &[f64]| losses.iter().sum::<f64>() / losses.len() as f64;
    assert!(mean(&losses[15..20]) < mean(&losses[..5]), "{losses:?}");
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
    let condenser = |run: &str| {
        let weights = place.weights(run, "stage2").0.into_iter();
        weights.filter(|(name, _)| name.starts_with("condenser.")).collect::<BTreeMap<_, _>>()
    };
    assert!(!condenser("first").is_empty());
    assert_eq!(condenser("seventh"), condenser("first"));
    let other = [&from_first[..], "model.condenser.member_share=true"];
    place.train("eighth", &other).fails_with(2, &["`model.condenser.member_share` = true"]);
}

#[test]
fn condensers_with_member_share_have_no_published_form() {
    let place = Place::new();
    let share = "model.condenser.member_share=true";
    place.train("run --only stage1", &[share]).ok();
    place.clift("export DIR/run --format pytorch -o DIR/stage1.ckpt").ok();
    place.train("run", &[share]).ok();
    let expected = "`model.condenser.member_share` = true: published condensers add the whole update";
    place.clift("export DIR/run --format pytorch -o DIR/run.ckpt").fails_with(2, &[expected]);
}

#[cfg(not(feature = "mpi"))]
#[test]
fn several_processes_of_a_build_without_mpi_are_told_how_to_build() {
    use std::process::Command;

    use crate::support::{BINARY, finish, start};

    let place = Place::new();
    let rank = |rank: &str| {
        let launcher = [("OMPI_COMM_WORLD_SIZE", "2"), ("OMPI_COMM_WORLD_RANK", rank)];
        finish(start(Command::new(BINARY).envs(launcher).args(place.train_args("run", &[]))))
    };
    rank("0").fails_with(
        2,
        &["a launcher started 2 processes, and this build has no MPI: ", "cargo build --release --features mpi"],
    );
    let other = rank("1");
    assert_eq!((other.code, other.stderr.as_str()), (Some(2), ""), "one rank prints");
    assert!(!place.at("run").exists());
}
