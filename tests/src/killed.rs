//! A training that kills itself with SIGKILL at a chosen moment: `clift-killed MOMENT train CONFIG [--set K=V]`.
//!
//! A moment is `step/STAGE/N` (step N was made, not saved), `saved/STAGE/N` (its checkpoint is there) or `set/N` (N sets
//! are clustered). Signals from outside cannot be timed like that: a step takes milliseconds.

use std::path::Path;
use std::process::Command;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use clift_train::{Config, Event, Run, RunOptions, read_config};

/// Returns the moment of an event.
fn moment_of(event: &Event) -> Option<String> {
    Some(match event {
        Event::Step(step) => format!("step/{}/{}", step.stage.name(), step.step),
        Event::Checkpoint { path } => {
            let name = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let stage = path.ancestors().nth(2).map(name).unwrap_or_default();
            format!("saved/{stage}/{}", name(path).trim_start_matches("step-").trim_start_matches('0'))
        }
        Event::Progress { done, .. } => format!("set/{done}"),
        _ => return None,
    })
}

fn main() {
    let mut args = std::env::args().skip(1);
    let moment = args.next().expect("a moment");
    assert_eq!(args.next().as_deref(), Some("train"));
    let config = args.next().expect("a config");
    let mut set = Vec::new();
    while let (Some(flag), Some(value)) = (args.next(), args.next()) {
        assert_eq!(flag, "--set");
        set.push(value);
    }
    let (config, _) = read_config::<Config>(config.as_ref(), &set).expect("a valid config");
    let mut kill = |event: &Event| {
        if moment_of(event).is_some_and(|now| now == moment) {
            let id = std::process::id().to_string();
            Command::new("kill").args(["-KILL", &id]).status().expect("kill runs");
            std::thread::sleep(Duration::from_mins(1));
        }
    };
    let run = Run::open(config, &RunOptions::default(), &mut kill).expect("a free run directory");
    run.train(None, &AtomicBool::new(false), &mut kill).expect("nothing else comes in between");
    panic!("the run ended before {moment}");
}
