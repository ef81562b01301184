//! Commands and the suite on a machine without a GPU.
#![cfg(target_os = "linux")]

use std::path::Path;
use std::process::{Command, Output};

/// Runs a command without a Vulkan or OpenGL driver.
fn without_adapter(command: &mut Command) -> (Option<i32>, String) {
    for variable in ["VK_ICD_FILENAMES", "VK_DRIVER_FILES", "__EGL_VENDOR_LIBRARY_FILENAMES"] {
        command.env(variable, "/nonexistent");
    }
    let Output { status, stdout, stderr } = command.output().expect("the command starts");
    (status.code(), [stdout, stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat())
}

#[test]
fn the_command_line_says_so_and_starts_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = folder.path().join("run");
    let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/tiny.toml");
    let set = format!("run_dir={:?}", run.display().to_string());
    for work in ["train", "bench"] {
        let mut command = Command::new(env!("CARGO_BIN_EXE_clift-under-test"));
        let (code, text) = without_adapter(command.arg(work).arg(&config).args(["--device", "wgpu", "--set", &set]));
        assert_eq!(code, Some(2), "{work}: {text}");
        assert!(text.contains("error: device `wgpu`: no adapter was found; install a Vulkan driver"), "{text}");
        assert!(!text.contains("panicked"), "{text}");
        assert!(!run.exists(), "{work} leaves no run behind");
    }
}

#[test]
fn cpu_runs_resume_and_load_no_driver() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = folder.path().join("run");
    let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("micro.toml");
    let train = |program: &str, words: &[&str]| {
        let mut command = Command::new(program);
        command.args(words).arg(&config).args(["--set", &format!("run_dir={:?}", run.display().to_string())]);
        command.env("LD_DEBUG", "files");
        without_adapter(&mut command)
    };
    // Killed in the middle of stage 1, after a checkpoint.
    let (code, text) = train(env!("CARGO_BIN_EXE_clift-killed"), &["saved/stage1/2", "train"]);
    assert_eq!(code, None, "{text}");
    let (code, text) = train(env!("CARGO_BIN_EXE_clift-under-test"), &["train"]);
    assert_eq!(code, Some(0), "{text}");
    assert!(text.contains("stage1: resumed after 2 of 6 steps") && !text.contains("panicked"), "{text}");
    let drivers: Vec<&str> =
        text.lines().filter(|line| line.contains("libvulkan") || line.contains("libEGL")).collect();
    assert!(text.contains("libc.so") && drivers.is_empty(), "{drivers:?}");
}

#[test]
fn the_suite_is_skipped_unless_it_is_required() {
    const SKIPPED: &str = "skipped: every_operation_gives_what_the_cpu_gives: device `wgpu`: no adapter was found";
    let this = || {
        let mut command = Command::new(std::env::current_exe().expect("the path of this test"));
        command
            .args(["--exact", "--nocapture", "every_operation_gives_what_the_cpu_gives"])
            .env_remove("CLIFT_REQUIRE_WGPU");
        command
    };
    let (code, text) = without_adapter(&mut this());
    assert!(code == Some(0) && text.contains(SKIPPED), "{code:?}: {text}");
    let (code, text) = without_adapter(this().env("CLIFT_REQUIRE_WGPU", "1"));
    assert_eq!(code, Some(101), "{text}");
    assert!(text.contains("CLIFT_REQUIRE_WGPU is set: device `wgpu`: no adapter"), "{text}");
}
