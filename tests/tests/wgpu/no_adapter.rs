//! Commands on a machine without a GPU.
#![cfg(target_os = "linux")]

use std::process::Command;

use crate::support::{BINARY, Place, finish, start};

#[test]
fn the_command_line_says_so_and_starts_nothing() {
    let place = Place::new();
    let missing = "error: device `wgpu`: no adapter was found; install a Vulkan driver";
    place.train("run", &["device='wgpu'"]).fails_with(2, &[missing]);
    assert!(!place.at("run").exists(), "no run is left behind");
    place.clift("bench REPO/tests/micro.toml --device wgpu").fails_with(2, &[missing]);
}

#[test]
fn cpu_runs_resume_and_load_no_driver() {
    let place = Place::new();
    place.kill_at("saved/stage1/2", "run", &[]);
    let mut command = Command::new(BINARY);
    command.args(place.train_args("run", &[])).env("LD_DEBUG", "files");
    let text = finish(start(&mut command)).ok().notes("stage1: resumed after 2 of 6 steps").stderr;
    let drivers: Vec<&str> =
        text.lines().filter(|line| line.contains("libvulkan") || line.contains("libEGL")).collect();
    assert!(text.contains("libc.so") && drivers.is_empty(), "{drivers:?}");
}
