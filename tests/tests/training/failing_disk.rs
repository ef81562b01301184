//! Full disks, unwritable folders, vanished data: the run ends with a message and can be resumed.

use std::process::Command;

use crate::support::{BINARY, Place, STAGE_1, finish, start};

/// Stage 1 of 24 steps, with a checkpoint at step 12.
const HALF: [&str; 4] = ["stage1.steps=24", "stage2.steps=12", "eval.every=12", "checkpoint={every=12, keep=2}"];

/// A limit on file sizes stops a save as a full disk does, without the right to mount one.
#[test]
fn failed_saves_keep_the_checkpoint_and_runs_resume() {
    let place = Place::new();
    place.train("whole", &HALF).ok();
    place.kill_at("saved/stage1/12", "run", &HALF);
    let model = place.bytes("run/stage1/checkpoints/step-000000012/model.bpk").len();
    // Blocks have 512 bytes or 1,024, by the shell; the config fits and the weights do not.
    let blocks = model / 1024 - 1;
    assert!(place.bytes("run/config.toml").len() < blocks * 512, "{model}");
    let mut command = Command::new("sh");
    command.args(["-c", "trap '' XFSZ; ulimit -f $0; exec \"$@\"", &blocks.to_string(), BINARY]);
    let message = finish(start(command.args(place.train_args("run", &HALF)))).fails_with(
        1,
        &[
            "error: writing a checkpoint failed: ",
            "File too large",
            "step-000000024.tmp/model.bpk\nstage1 stopped after step 24; ",
        ],
    );
    place.assert_names_last_checkpoint("run", 12, &message);
    place.train("run", &HALF).ok();
    place.assert_same_run("run", "whole");
}

#[test]
fn impossible_run_directories_are_errors() {
    let place = Place::new();
    place.write("file", "not a folder");
    place.train("file/run", &[]).fails_naming(1, &["making the run directory failed: "], "file/run");
    // A file in place of a folder.
    place.copy(&STAGE_1, "run");
    place.write("run/clusters.tmp", "not a folder");
    place.train("run", &[]).fails_naming(1, &[], "run/clusters.tmp");
    assert!(place.at("run/stage1/model.safetensors").exists());
}

#[test]
fn vanished_data_stops_runs_which_resume_with_it() {
    let place = Place::new();
    let data = place.at("rooms");
    let folder = data.display().to_string();
    place.clift("data synth DIR/rooms --scenes 8 --frames 8 --size 16x16 --set samples_per_pixel=1").ok();
    let source = format!(
        "data={{source='chunks', root='{folder}', width=16, height=16, num_threads=0, \
         views={{min_context=2, max_context=2, min_gap=[3, 3], max_gap=[6, 6], warm_up_steps=0, num_targets=2}}}}"
    );
    let set = ["stage1.steps=200", "eval.every=0", "checkpoint={every=1000, keep=2}", source.as_str()];
    place.train("whole", &set).ok();
    let mut child = place.start_train("run", &set);
    place.wait_for_steps("run", &mut child, 5);
    std::fs::rename(&data, place.at("gone")).expect("renames");
    let message = finish(child).fails_with(1, &["no usable scene for slot ", "000000.torch"]);
    let steps = place.metrics("run").len() as u64;
    assert!((5..200).contains(&steps), "{steps}");
    assert!(message.contains(&format!("\nstage1 stopped after step {steps}; ")), "{message}");
    place.assert_names_last_checkpoint("run", steps, &message);

    place.train("run", &set).fails_with(1, &[&folder]);
    std::fs::rename(place.at("gone"), &data).expect("renames");
    place.train("run", &set).ok();
    place.assert_same_run("run", "whole");
}
