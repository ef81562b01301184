use std::collections::BTreeMap;
use std::path::Path;
use std::rc::Rc;
use std::sync::atomic::{AtomicBool, Ordering};

use serde_json::Value;

use super::*;
use crate::config::config::Stage1Config;
use crate::config::parse::read_config;
use crate::distributed::testing::on_threads;
use crate::events::StepEvent;
use crate::step::batch::BatchTokens;
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
    let mut views = csv_without_times(&folder.join("eval/views.csv"));
    views.sort();
    files.insert("eval/views.csv".into(), views.join("\n").into_bytes());
    for item in std::fs::read_dir(folder.join("eval/sheets")).expect("sheets") {
        let path = item.expect("readable").path();
        files.insert(
            format!("eval/sheets/{}", path.file_name().expect("a name").display()),
            std::fs::read(&path).expect("a file"),
        );
    }
    files
}

fn csv_without_times(path: &Path) -> Vec<String> {
    let text = std::fs::read_to_string(path).expect("views");
    let kept = |line: &str| {
        let fields = line.split(',').enumerate().filter(|(i, _)| ![8, 9].contains(i)).map(|(_, field)| field);
        fields.collect::<Vec<_>>().join(",")
    };
    text.lines().map(kept).collect()
}

#[track_caller]
fn assert_same(found: &Path, expected: &Path) {
    let (found, expected) = (results(found), results(expected));
    assert_eq!(found.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>());
    for (name, bytes) in &expected {
        assert!(found[name] == *bytes, "{name} differs:\n{}\n{}", show(&found[name]), show(bytes));
    }
}

fn show(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).chars().filter(|c| !c.is_control()).take(3000).collect()
}

#[test]
fn ranks_end_bit_for_bit_where_one_process_with_as_many_parts_ends() {
    let place = tempfile::tempdir().expect("a folder");
    let muon = "stage1.optimizer={algorithm=\"muon\", learning_rate=1e-3, warm_up_steps=2}";
    // A low spike factor skips steps, and narrow clipping scales them.
    let spikes = "stage2.optimizer={learning_rate=1e-3, warm_up_steps=2, spike_factor=1.05, max_bad_steps=90, max_grad_norm=1e-3}";
    let cases: [(&str, &[&str]); 3] = [
        ("plain", &["stage1.batch_size=4", "stage2.batch_size=5", "stage2.steps=30", "eval.num_scenes=8", spikes]),
        ("checkpointed", &["stage1.batch_size=4", "stage2.batch_size=4", "activation_checkpointing=true", muon]),
        ("half", &["stage1.batch_size=4", "stage2.batch_size=4", "precision=\"f16\"", "data.flip=true"]),
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
    // Without `accumulate`, every rank has a part.
    let set = &cases[0].1;
    let two = place.path().join("implied");
    train_whole(2, &micro(&two, set));
    assert_same(&two, &place.path().join("plain-2"));
}

#[test]
fn more_ranks_than_scenes_train_like_fewer() {
    let place = tempfile::tempdir().expect("a folder");
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
fn first_batches_have_half_the_resolution_and_the_same_views() {
    let place = tempfile::tempdir().expect("a folder");
    let mut sizes = Vec::new();
    let mut sink = |event: &Event| {
        if let Event::ImageSize { size, done, last_step_of_size, .. } = event {
            sizes.push((*size, *done, *last_step_of_size));
        }
    };
    let run = Run::open(micro(place.path(), &LONG), &RunOptions::default(), &mut sink).expect("valid");
    let opened = open_training_dataset(&run.config.data, run.config.stage1.steps, &mut |_, _| ()).expect("rooms");
    let reader = run.reader(opened, Split::Train, &mut sink).expect("readable");
    let whole =
        Config { stage1: Stage1Config { half_resolution: 0.0, ..run.config.stage1.clone() }, ..run.config.clone() };
    let batches = |config| Stage1Batches::new(config, &reader, run.parts(Stage::Stage1)).expect("valid");
    let (batches, whole) = (batches(&run.config), batches(&whole));
    for (step, divisor) in [(0, 2), (12, 2), (13, 1), (23, 1)] {
        let (found, whole) = (batches.batch(step).expect("readable"), whole.batch(step).expect("readable"));
        for (clip, whole) in found.clips.iter().zip(&whole.clips) {
            assert_eq!(clip.key, whole.key);
            for (views, whole) in [(&clip.context, &whole.context), (&clip.target, &whole.target)] {
                assert_eq!((views.width, views.height), (16 / divisor, 16 / divisor), "step {step}");
                assert_eq!(views.frame_index, whole.frame_index);
                for (camera, whole) in views.cameras.iter().zip(&whole.cameras) {
                    assert_eq!(camera.c2w, whole.c2w);
                    let pixels = camera.intrinsics.to_array().map(|pixels| pixels * divisor as f64);
                    assert_eq!(pixels, whole.intrinsics.to_array());
                }
            }
        }
        // Ids of tokens that exist: one patch of 8 pixels for each of two views, or four.
        if let BatchTokens::Subsets(subsets) = &found.tokens {
            let num_tokens = 2 * (2 / divisor as u32).pow(2);
            assert!(subsets.iter().flatten().flatten().all(|&token| token < num_tokens));
        }
    }
    run.train(Some(Stage::Stage1.into()), &AtomicBool::new(false), &mut sink).expect("trains");
    assert_eq!(sizes, [([8, 8], 0, 13), ([16, 16], 13, 24)]);
    drop(run);

    // The first 13 steps had small images, so no later step may have them.
    let extend = |steps: &str| {
        let config = micro(place.path(), &[&LONG[..], &[steps]].concat());
        Run::open(config, &RunOptions { extend: true, ..RunOptions::default() }, &mut |_: &Event| {}).map(drop)
    };
    let message = extend("stage1.steps=46").unwrap_err().to_string();
    assert!(message.contains("half the width and height again") && message.contains("write at most 45"), "{message}");
    extend("stage1.steps=45").expect("24 of 45 steps have small images, and 24 are made");

    let narrow = micro(&place.path().join("narrow"), &[&LONG[..], &["data.width=8"]].concat());
    let message = Run::open(narrow, &RunOptions::default(), &mut |_: &Event| {}).map(drop).unwrap_err().to_string();
    assert!(message.starts_with("`stage1.half_resolution` = 0.55: write 0, or a multiple of"), "{message}");
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

#[test]
fn other_settings_of_one_rank_are_refused() {
    let place = tempfile::tempdir().expect("a folder");
    let ended = on_threads(2, |ranks| {
        let seed = format!("seed={}", ranks.rank());
        let config = micro(place.path(), &[&seed]);
        let ranks = Rc::new(ranks);
        let run = Run::open_on(ranks.clone(), config, &RunOptions::default(), &mut |_: &Event| {});
        ranks.finish(run.map(drop)).unwrap_err().to_string()
    });
    assert!(ended[0].starts_with("the configs of rank 1 differ from rank 0's"), "{ended:?}");
}

#[test]
fn a_failing_save_ends_all_ranks() {
    let place = tempfile::tempdir().expect("a folder");
    let config = micro(&place.path().join("run"), &LONG);
    // A file where the folder of the checkpoints should be.
    let stage1 = place.path().join("run/stage1");
    let ended = train(2, &config, |rank, event| {
        if rank == 0 && matches!(event, Event::StepStarted { run_step: RunStep::Train(Stage::Stage1), .. }) {
            std::fs::create_dir_all(&stage1).expect("writable");
            std::fs::write(stage1.join("checkpoints"), "full").expect("writable");
        }
        false
    });
    let texts: Vec<String> = ended.into_iter().map(|end| end.unwrap_err().to_string()).collect();
    assert!(texts[0].contains("failed: ") && texts[0].contains("checkpoints"), "{texts:?}");
    assert!(texts[1].starts_with("rank 0 failed: "), "{texts:?}");
}
