use std::collections::BTreeMap;
use std::path::Path;
use std::rc::Rc;
use std::sync::atomic::{AtomicBool, Ordering};

use serde_json::Value;

use super::*;
use crate::config::parse::read_config;
use crate::distributed::testing::on_threads;
use crate::events::StepEvent;
use crate::testing::fixture;

/// The micro run in `folder`, with changed keys.
fn micro(folder: &Path, set: &[&str]) -> Config {
    let run_dir = format!("run_dir='{}'", folder.display());
    let overrides: Vec<String> = set.iter().map(|&text| text.to_owned()).chain([run_dir]).collect();
    read_config(&fixture("../tests/micro.toml"), &overrides).expect("valid").0
}

/// Trains on ranks that are threads. `stop` sees the events of every rank and may set its flag.
fn train(
    num_ranks: usize,
    config: &Config,
    stop: impl Fn(usize, &Event) -> bool + Sync,
) -> Vec<Result<Option<Summary>, TrainError>> {
    on_threads(num_ranks, |ranks| {
        let (rank, flag) = (ranks.rank(), AtomicBool::new(false));
        let mut sink = |event: &Event| {
            if stop(rank, event) {
                flag.store(true, Ordering::Relaxed);
            }
        };
        let ranks = Rc::new(ranks);
        let run = Run::open_on(ranks.clone(), config.clone(), &RunOptions::default(), &mut sink);
        ranks.finish(run.and_then(|run| run.train(None, &flag, &mut sink)))
    })
}

fn train_whole(num_ranks: usize, config: &Config) {
    for (rank, result) in train(num_ranks, config, |_, _| false).into_iter().enumerate() {
        assert_eq!(result.expect("trains").is_some(), rank == 0, "rank 0 alone has the results");
    }
}

fn json_lines(path: &Path) -> Vec<Value> {
    let text = std::fs::read_to_string(path).unwrap_or_default();
    text.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect()
}

/// The files of a run that must not depend on the number of ranks, without times.
fn results(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut files: BTreeMap<String, Vec<u8>> = BTreeMap::new();
    for name in ["stage1/model.safetensors", "stage2/model.safetensors", "clusters/index.json", "clusters/clusters.bin"]
    {
        files.insert(name.into(), std::fs::read(folder.join(name)).expect("the run has it"));
    }
    for name in ["metrics.jsonl", "validation.jsonl", "bad_steps.jsonl", "skipped.jsonl"] {
        let mut lines = json_lines(&folder.join(name));
        for line in &mut lines {
            for key in ["time", "step_s", "images_per_s", "peak_bytes"] {
                line.as_object_mut().expect("an object").remove(key);
            }
        }
        files.insert(name.into(), serde_json::to_vec(&lines).expect("JSON"));
    }
    files
}

#[track_caller]
fn assert_same(found: &Path, expected: &Path) {
    let (found, expected) = (results(found), results(expected));
    assert_eq!(found.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>());
    for (name, bytes) in &expected {
        assert!(found[name] == *bytes, "{name} differs");
    }
}

#[test]
fn ranks_end_bit_for_bit_where_one_process_with_as_many_parts_ends() {
    let place = tempfile::tempdir().expect("a folder");
    let muon = "stage1.optimizer={algorithm=\"muon\", learning_rate=1e-3, warm_up_steps=2}";
    // A low spike factor skips steps, and narrow clipping scales them.
    let spikes = "stage2.optimizer={learning_rate=1e-3, warm_up_steps=2, spike_factor=1.05, max_bad_steps=90, max_grad_norm=1e-3}";
    let cases: [(&str, &[&str]); 3] = [
        ("plain", &["stage1.batch_size=4", "stage2.batch_size=5", "stage2.steps=30", "eval.num_scenes=8", spikes]),
        ("muon", &["stage1.batch_size=4", "stage2.batch_size=4", muon]),
        ("half", &["stage1.batch_size=4", "stage2.batch_size=4", "precision=\"f16\""]),
    ];
    for (name, set) in cases {
        let ranks: &[(usize, usize)] = if name == "plain" { &[(2, 2), (4, 4), (2, 4), (3, 4)] } else { &[(3, 4)] };
        for &(num_ranks, num_parts) in ranks {
            let one = place.path().join(format!("{name}-{num_parts}"));
            let parts = [1, 2].map(|stage| format!("stage{stage}.accumulate={num_parts}"));
            let set: Vec<&str> = set.iter().copied().chain(parts.iter().map(String::as_str)).collect();
            if !one.exists() {
                train_whole(1, &micro(&one, &set));
            }
            let several = place.path().join(format!("{name}-{num_ranks}-ranks-{num_parts}"));
            train_whole(num_ranks, &micro(&several, &set));
            assert_same(&several, &one);
        }
        if name == "plain" {
            assert!(!json_lines(&place.path().join("plain-2/bad_steps.jsonl")).is_empty(), "some steps are skipped");
        }
    }
    // Without `accumulate`, every rank has a part; a third rank has none of two scenes.
    let (one, three) = (place.path().join("one"), place.path().join("three"));
    train_whole(1, &micro(&one, &["stage1.accumulate=2", "stage2.accumulate=2"]));
    train_whole(3, &micro(&three, &[]));
    assert_same(&three, &one);
}

/// One of the interruptions is at the change of the resolution.
const LONG: [&str; 7] = [
    "stage1.steps=24",
    "stage1.half_resolution=0.55",
    "stage2.steps=12",
    "stage1.batch_size=4",
    "stage2.batch_size=4",
    "stage1.accumulate=3",
    "stage2.accumulate=3",
];

#[test]
fn interrupted_runs_resume_on_any_number_of_ranks() {
    let place = tempfile::tempdir().expect("a folder");
    let (whole, parts) = (place.path().join("whole"), place.path().join("parts"));
    train_whole(1, &micro(&whole, &LONG));
    let config = micro(&parts, &LONG);
    let is_step = |event: &Event, stage: Stage, step: u64| matches!(event, Event::Step(StepEvent { stage: s, step: n, .. }) if (*s, *n) == (stage, step));
    // The signal reaches one rank only.
    let interrupted = |num_ranks, signalled: usize, stage, step| {
        let ended = train(num_ranks, &config, |rank, event| rank == signalled && is_step(event, stage, step));
        for end in ended {
            assert!(matches!(end, Err(TrainError::Interrupted { step: at }) if at == step), "{end:?}");
        }
    };
    interrupted(2, 1, Stage::Stage1, 5);
    interrupted(3, 0, Stage::Stage1, 13);
    interrupted(1, 0, Stage::Stage1, 17);
    let ended = train(2, &config, |rank, event| {
        rank == 1 && matches!(event, Event::Progress { run_step: RunStep::Clusters, done: 2, .. })
    });
    assert!(ended.iter().all(|end| matches!(end, Err(TrainError::Interrupted { step: 4 }))), "{ended:?}");
    interrupted(3, 2, Stage::Stage2, 7);
    train_whole(2, &config);
    assert_same(&parts, &whole);
}

#[test]
fn first_batches_have_half_the_resolution() {
    let place = tempfile::tempdir().expect("a folder");
    let mut sink = |_: &Event| {};
    let run = Run::open(micro(place.path(), &LONG), &RunOptions::default(), &mut sink).expect("valid");
    let training = run.open_training(&AtomicBool::new(false), &mut sink).map(|training| training.reader);
    let batches = Stage1Batches::new(&run.config, &training.expect("rooms"), run.parts(Stage::Stage1)).expect("valid");
    for (step, size) in [(0, 8), (12, 8), (13, 16), (23, 16)] {
        let batch = batches.batch(step).expect("readable");
        assert!(batch.clips.iter().all(|clip| (clip.context.width, clip.target.height) == (size, size)), "step {step}");
    }
}

#[test]
fn a_rank_without_data_ends_all_and_rank_0_saves_first() {
    let place = tempfile::tempdir().expect("a folder");
    let config = micro(place.path(), &LONG);
    let ended = on_threads(2, |ranks| {
        let ranks = Rc::new(ranks);
        let work = || {
            let mut sink = |_: &Event| {};
            let run = Run::open_on(ranks.clone(), config.clone(), &RunOptions::default(), &mut sink)?;
            let opened = open_training_dataset(&run.config.data, run.config.stage1.steps, &mut |_, _| ())?;
            let reader = run.reader(opened, Split::Train, &mut sink)?;
            let validation = run.validation(Split::Test, &mut sink)?;
            let batches = Stage1Batches::new(&run.config, &reader, run.parts(Stage::Stage1))?;
            let is_torn = ranks.rank() == 1;
            let batches: Arc<MakeBatch> = Arc::new(move |step| match step {
                9 if is_torn => Err(TrainError::NoScenes { reason: "the disk of rank 1 is gone".into() }),
                _ => batches.batch(step),
            });
            let start = |_: &mut dyn Sink| Ok(run.new_model());
            train_stage(&run.plan(Stage::Stage1, batches), start, &validation, &AtomicBool::new(false), &mut sink)
        };
        ranks.finish(work().map(drop)).unwrap_err().to_string()
    });
    assert!(
        ended[0].starts_with("rank 1 failed: no usable scene: the disk of rank 1 is gone\nstage1 stopped"),
        "{ended:?}"
    );
    assert!(ended[0].contains("step-000000009"), "rank 0 saved the steps before: {}", ended[0]);
    assert!(ended[1].starts_with("no usable scene: the disk of rank 1 is gone\n"), "{ended:?}");
    // The run resumes where it was.
    train_whole(3, &config);
}
