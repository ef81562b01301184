//! A second command on an existing run: kept, refused and repeated work.

use crate::support::{Place, STAGE_1, WHOLE, files, finish, number, signal, wait_until};

#[test]
fn micro_batches_give_the_same_update() {
    let place = Place::new();
    let batches = ["stage1.batch_size=5", "stage2.batch_size=5"];
    place.train("at_once", &batches).ok();
    // Three scenes and two: parts weigh as many scenes as they have. Stage 2 on its own, because K-means may cluster
    // other tokens after the smallest change of the encoder.
    for stage in ["stage1", "stage2"] {
        let accumulate = format!("{stage}.accumulate=2");
        place.train(stage, &[&batches[..], &[accumulate.as_str()]].concat()).ok();
        let (whole, parts) = (place.weights("at_once", stage), place.weights(stage, stage));
        let moves: Vec<f64> = parts.moved_from(&whole).collect();
        // Sums in another order differ in the last bit of f32. Adam divides by the size of a gradient, so one that is
        // nearly zero may move its weight by another share of the rate of 1e-3; 2e-6 was the most, 1e-9 the mean.
        let most = moves.iter().copied().fold(0.0, f64::max);
        let mean = moves.iter().sum::<f64>() / moves.len() as f64;
        assert!(most < 1e-4 && mean < 1e-7, "{stage}: {most:e}, {mean:e}");
        for (part, whole) in place.metrics(stage).iter().zip(&place.metrics("at_once")) {
            let relative = |key: &str| (number(part, key) / number(whole, key) - 1.0).abs();
            // Eight times the rounding of one f32.
            let same = relative("loss") < 1e-6 && relative("grad_norm") < 1e-6;
            assert!(same || part["stage"] != stage, "{part} is not {whole}");
        }
    }
}

#[test]
fn a_finished_run_is_left_as_it_is() {
    let place = Place::with(&WHOLE);
    let before = files(&place.at("run"));
    place.train("run", &[]).ok().notes("the run is trained and evaluated");
    assert!(files(&place.at("run")) == before, "a file changed");
}

#[test]
fn changed_settings_are_refused_unless_results_stay_equal() {
    let place = Place::with(&STAGE_1);
    let before = files(&place.at("run"));
    for (change, expected) in [
        ("seed=1", "  seed: 0 -> 1"),
        ("stage1.steps=5", "  stage1.steps: 6 -> 5"),
        ("stage1.optimizer.learning_rate=2e-3", "  stage1.optimizer.learning_rate: 0.001 -> 0.002"),
        ("clusters.grid=[0.5]", "  clusters.grid: [\"1/2\", \"1/1\"] -> [\"1/2\"]"),
        ("stage1.init_from=other", "  stage1.init_from: not set -> \"other\""),
    ] {
        let settings = format!("settings:\n{expected}\nresume");
        place.train("run", &[change]).fails_naming(2, &[&settings, "--fresh"], "/run");
    }
    let settings = "settings:\n  seed: 0 -> 1\n  stage1.steps: 6 -> 7\nresume";
    place.train("run", &["seed=1", "stage1.steps=7"]).fails_with(2, &[settings]);
    assert!(files(&place.at("run")) == before, "a refusal changes nothing");

    let free =
        ["data.num_threads=0", "checkpoint.every=3", "eval.num_scenes=1", "device=ndarray", "model.patch_grids=2"];
    place.train("run --only clusters", &free).ok();
}

#[test]
fn fresh_moves_the_former_run_aside() {
    let place = Place::with(&STAGE_1);
    let before = files(&place.at("run"));
    place.train("run --fresh --only clusters", &[]).fails_with(2, &["--fresh"]);
    assert!(files(&place.at("run")) == before, "a later stage cannot be fresh: nothing is moved");
    place.train("run --only stage1 --fresh", &["stage1.steps=3"]).ok().notes("renamed the existing run to ");
    assert!(files(&place.at("run.1")).into_values().eq(before.into_values()), "every byte of it");
    assert_eq!(place.metrics("run").len(), 3);
    place.train("run --only stage1 --fresh", &[]).ok();
    assert_eq!((place.metrics("run.2").len(), place.metrics("run").len()), (3, 6));
}

#[test]
fn folders_that_are_not_runs_are_refused() {
    let place = Place::new();
    place.write("letters/letter.txt", "mine");
    let refused = "the folder has files and is not a run (it has no run.json)";
    for flags in ["", " --fresh", " --only stage1"] {
        place.train(&format!("letters{flags}"), &[]).fails_with(2, &[refused]);
    }
    assert_eq!(place.names(""), ["letters"], "nothing is renamed");
    assert_eq!(place.names("letters"), ["letter.txt"], "no lock stays");
    std::fs::create_dir(place.at("empty")).expect("writable");
    place.train("empty --only stage1 --fresh", &[]).ok();
}

#[test]
fn an_evaluation_can_be_interrupted() {
    let place = Place::new();
    place.train("run", &["data.synthetic.num_scenes=2000"]).ok();
    // Thousands of scenes with rows of targets: far longer than the signal takes.
    let words = "eval DIR/run --set eval.num_scenes=0 --set eval.num_sheets=2000";
    let before = files(&place.at("run/eval"));
    place.clift(words).fails_with(2, &["/run/eval: the folder holds an evaluation; replace it with --force"]);
    assert!(files(&place.at("run/eval")) == before, "nothing is replaced unasked");

    let mut child = place.start(&format!("{words} --force"));
    let names = || place.names("run/eval/sheets");
    let (before, summary) = (names(), place.bytes("run/eval/summary.json"));
    // Sheets are made in a folder of their own, and take the place of the former ones all together.
    let num_new = || {
        let new = names().into_iter().filter(|name| !before.contains(name));
        let items = new.map(|name| std::fs::read_dir(place.at("run/eval/sheets").join(name)));
        items.map(|items| items.map_or(0, Iterator::count)).sum::<usize>()
    };
    wait_until(&mut child, "three sheets", || num_new() >= 3);
    // A second evaluation into the folder does not start.
    place.eval("run").fails_with(1, &["output folder ", "/run/eval is in use by process ", "set another --out"]);
    signal(&child, "-INT");
    finish(child).fails_with(130, &["interrupted during the evaluation, after ", " scenes; no results were written"]);
    assert_eq!((names(), place.bytes("run/eval/summary.json")), (before, summary));
    // A shorter evaluation removes the sheets of a longer one and no other file.
    place.write("run/eval/sheets/mine.png", "");
    place.eval("run --set eval.num_sheets=1 --set eval.num_scenes=2").ok();
    assert_eq!(names().len(), 2);
}

#[test]
fn resumed_runs_need_neither_initial_weights_nor_clusters() {
    for (first, stage) in [(&STAGE_1, "stage1"), (&WHOLE, "stage2")] {
        let place = Place::new();
        place.copy(first, "first");
        let from = format!("{stage}.init_from=\"{}\"", place.at("first").display());
        place.kill_at(&format!("saved/{stage}/2"), "run", &[&from]);
        std::fs::remove_dir_all(place.at("first")).expect("removes");
        place.train("run", &[&from]).ok();
        std::fs::remove_dir_all(place.at("run/clusters")).expect("removes");
        place.train("run", &[&from]).ok();
        assert!(!place.at("run/clusters").exists(), "nothing was clustered again");
    }
}

#[test]
fn a_begun_run_without_its_config_is_refused() {
    let place = Place::with(&STAGE_1);
    std::fs::remove_file(place.at("run/config.toml")).expect("removes");
    place.train("run", &["seed=1"]).fails_with(1, &["config.toml", "start a new run with --fresh"]);
}
