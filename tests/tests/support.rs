//! Runs the command line in temporary folders and reads the files of the runs.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use serde_json::Value;
use tempfile::TempDir;

pub fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("tests/ lies in the repository").join(path)
}

/// Reports that this test cannot run on this machine, as a line `skipped: TEST: REASON` that `.ci/run` repeats at its end.
///
/// # Panics
/// Where the variable `CLIFT_REQUIRE_TOOL` is set, such as `CLIFT_REQUIRE_CHROMIUM` for the tool `chromium`.
#[track_caller]
pub fn skip(tool: &str, reason: &str) {
    let variable = format!("CLIFT_REQUIRE_{}", tool.to_uppercase());
    assert!(std::env::var_os(&variable).is_none(), "{variable} is set: {reason}");
    let thread = std::thread::current();
    let test = thread.name().filter(|name| *name != "main").unwrap_or(tool);
    // Not `eprintln`: the test harness hides what a passing test prints by it.
    let line = format!("skipped: {test}: {reason}\n");
    std::io::stderr().write_all(line.as_bytes()).expect("the standard error is open");
}

#[derive(Debug)]
pub struct Ran {
    pub code: Option<i32>,
    pub stdout: String,
    pub stderr: String,
}

impl Ran {
    #[track_caller]
    pub fn ok(self) -> Self {
        assert_eq!(self.code, Some(0), "stdout:\n{}\nstderr:\n{}", self.stdout, self.stderr);
        self
    }

    /// Expects this exit code, an error and no panic; returns the error stream.
    #[track_caller]
    pub fn fails(self, code: i32) -> String {
        assert_eq!(self.code, Some(code), "stdout:\n{}\nstderr:\n{}", self.stdout, self.stderr);
        assert!(self.stderr.contains("error: ") && !self.stderr.contains("panicked"), "{}", self.stderr);
        self.stderr
    }

    /// Expects this exit code and these parts of the error; returns the error stream.
    #[track_caller]
    pub fn fails_with(self, code: i32, parts: &[&str]) -> String {
        let message = self.fails(code);
        for part in parts {
            assert!(message.contains(part), "{part}\nis not in\n{message}");
        }
        message
    }

    /// Expects this exit code, these parts of the error and its end, which names a file or what to do.
    #[track_caller]
    pub fn fails_naming(self, code: i32, parts: &[&str], end: &str) {
        let message = self.fails_with(code, parts);
        assert!(message.trim_end().ends_with(end), "{end}\nis not the end of\n{message}");
    }

    #[track_caller]
    pub fn prints(self, part: &str) -> Self {
        assert!(self.stdout.contains(part), "{part}\nis not in\n{}", self.stdout);
        self
    }

    #[track_caller]
    pub fn notes(self, part: &str) -> Self {
        assert!(self.stderr.contains(part), "{part}\nis not in\n{}", self.stderr);
        self
    }
}

pub const BINARY: &str = env!("CARGO_BIN_EXE_clift-under-test");

/// Starts a command that [`finish`] waits for, on the CPU: in a build with wgpu it finds no adapter, whose kernels would take
/// minutes to compile.
pub fn start(command: &mut Command) -> Child {
    for variable in ["VK_ICD_FILENAMES", "VK_DRIVER_FILES", "__EGL_VENDOR_LIBRARY_FILENAMES"] {
        command.env(variable, "/nonexistent");
    }
    // The shipped model is unpacked there.
    command.env("XDG_DATA_HOME", env!("CARGO_TARGET_TMPDIR"));
    let piped = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    piped.spawn().expect("the binary under test starts")
}

pub fn signal(child: &Child, name: &str) {
    let sent = Command::new("kill").args([name, &child.id().to_string()]).status().expect("kill runs");
    assert!(sent.success(), "the run is still there to be stopped");
}

#[track_caller]
pub fn wait_until(child: &mut Child, what: &str, is_there: impl Fn() -> bool) {
    let started = Instant::now();
    while !is_there() {
        assert!(child.try_wait().expect("a child").is_none(), "the command ended before {what}");
        assert!(started.elapsed() < Duration::from_mins(1), "no {what} within a minute");
        std::thread::sleep(Duration::from_millis(2));
    }
}

pub fn finish(child: Child) -> Ran {
    let output = child.wait_with_output().expect("the binary under test ends");
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).expect("it prints UTF-8");
    Ran { code: output.status.code(), stdout: text(output.stdout), stderr: text(output.stderr) }
}

/// A micro run that several tests copy, trained once.
pub struct Shared {
    words: &'static str,
    set: &'static [&'static str],
    /// The folder in which it was trained, and its files.
    files: OnceLock<(String, BTreeMap<PathBuf, Vec<u8>>)>,
}

/// The whole micro run, with its evaluation.
pub static WHOLE: Shared = Shared::new("run", &[]);
pub static STAGE_1: Shared = Shared::new("run --only stage1", &[]);
/// A run whose renderings depend on the tokens, and whose methods differ by more than rounding.
pub static LONGER: Shared = Shared::new("run", &["stage1.steps=60", "stage2.steps=20"]);

impl Shared {
    /// The micro run `run` with flags and changed keys, see [`Place::train`].
    pub const fn new(words: &'static str, set: &'static [&'static str]) -> Self {
        Self { words, set, files: OnceLock::new() }
    }
}

pub struct Place(TempDir);

impl Place {
    pub fn new() -> Self {
        Self(tempfile::tempdir().expect("a temporary folder"))
    }

    pub fn with(shared: &Shared) -> Self {
        let place = Self::new();
        place.copy(shared, "run");
        place
    }

    pub fn at(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// The words of a text, where `DIR` is the folder and `REPO` the repository.
    fn words(&self, text: &str) -> Vec<String> {
        let (dir, repository) = (self.at("").display().to_string(), repository("").display().to_string());
        text.split_whitespace().map(|word| word.replace("DIR/", &dir).replace("REPO/", &repository)).collect()
    }

    /// Arguments that train the micro run of a name, which flags may follow, with changed keys.
    pub fn train_args(&self, words: &str, set: &[&str]) -> Vec<String> {
        let (name, flags) = words.split_once(' ').unwrap_or((words, ""));
        let run_dir = format!("run_dir=\"{}\"", self.at(name).display());
        let mut args = self.words(&format!("train REPO/tests/micro.toml {flags}"));
        args.extend([run_dir.as_str()].iter().chain(set).flat_map(|text| ["--set".into(), (*text).into()]));
        args
    }

    /// Trains the micro run of a name, which flags may follow, with changed keys to its end.
    pub fn train(&self, words: &str, set: &[&str]) -> Ran {
        finish(self.start_train(words, set))
    }

    pub fn start_train(&self, words: &str, set: &[&str]) -> Child {
        start(Command::new(BINARY).args(self.train_args(words, set)))
    }

    /// Runs a training that must kill itself at `moment` (see `clift-killed`).
    #[track_caller]
    pub fn kill_at(&self, moment: &str, words: &str, set: &[&str]) {
        let mut command = Command::new(env!("CARGO_BIN_EXE_clift-killed"));
        let ran = finish(start(command.arg(moment).args(self.train_args(words, set))));
        assert_eq!(ran.code, None, "{moment}: stdout:\n{}\nstderr:\n{}", ran.stdout, ran.stderr);
    }

    #[track_caller]
    pub fn wait_for_steps(&self, run: &str, child: &mut Child, count: usize) {
        let metrics = self.at(&format!("{run}/metrics.jsonl"));
        let num_steps = || std::fs::read_to_string(&metrics).unwrap_or_default().lines().count();
        wait_until(child, &format!("step {count}"), || num_steps() >= count);
    }

    /// Copies a shared run to `name`, as if it had been trained here.
    pub fn copy(&self, shared: &Shared, name: &str) {
        let (former, files) = shared.files.get_or_init(|| {
            let place = Self::new();
            place.train(shared.words, shared.set).ok();
            (place.at("run").display().to_string(), files(&place.at("run")))
        });
        let run = self.at(name).display().to_string();
        for (path, bytes) in files {
            let name = format!("{name}/{}", path.display());
            // The only file that holds the path of its run.
            if path == Path::new("config.toml") {
                self.write(&name, String::from_utf8_lossy(bytes).replace(former, &run));
            } else {
                self.write(&name, bytes);
            }
        }
    }

    pub fn clift(&self, words: &str) -> Ran {
        finish(self.start(words))
    }

    pub fn start(&self, words: &str) -> Child {
        start(Command::new(BINARY).args(self.words(words)))
    }

    /// Evaluates the run of a name, which flags may follow, and replaces an existing evaluation.
    pub fn eval(&self, words: &str) -> Ran {
        self.clift(&format!("eval DIR/{words} --force"))
    }

    pub fn bytes(&self, name: &str) -> Vec<u8> {
        std::fs::read(self.at(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
    }

    pub fn text(&self, name: &str) -> String {
        String::from_utf8(self.bytes(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
    }

    pub fn json(&self, name: &str) -> Value {
        serde_json::from_slice(&self.bytes(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
    }

    pub fn json_lines(&self, name: &str) -> Vec<Value> {
        let text = self.text(name);
        text.lines().map(|line| serde_json::from_str(line).unwrap_or_else(|error| panic!("{line}: {error}"))).collect()
    }

    pub fn metrics(&self, run: &str) -> Vec<Value> {
        self.json_lines(&format!("{run}/metrics.jsonl"))
    }

    /// The lines of a run's `metrics.jsonl` and `validation.jsonl` without times.
    pub fn metrics_but_time(&self, run: &str) -> Vec<Value> {
        let mut lines = self.metrics(run);
        if self.at(&format!("{run}/validation.jsonl")).exists() {
            lines.extend(self.json_lines(&format!("{run}/validation.jsonl")));
        }
        for line in &mut lines {
            let of_machine = ["step_s", "images_per_s", "peak_bytes", "time"];
            line.as_object_mut().expect("an object").retain(|key, _| !of_machine.contains(&key.as_str()));
        }
        lines
    }

    pub fn weights(&self, run: &str, stage: &str) -> Weights {
        self.model(&format!("{run}/{stage}"))
    }

    pub fn model(&self, name: &str) -> Weights {
        Weights::read(&self.bytes(&format!("{name}/model.safetensors")))
    }

    /// Expects the same files but for times: weights, clusters, metrics, skipped steps, samples, the progress in the last
    /// checkpoints, and the evaluation.
    pub fn assert_same_run(&self, run: &str, other: &str) {
        assert_eq!(self.metrics_but_time(run), self.metrics_but_time(other), "no step is missing or doubled");
        let compared = |run: &str| {
            let mut files = files(&self.at(run));
            // The report holds the date, `views.csv` times, and `config.toml` the path of its run.
            files.retain(|path, _| {
                let name = path.display().to_string();
                let other = ["metrics.jsonl", "validation.jsonl", "config.toml", "lock"].contains(&name.as_str());
                !other && !name.starts_with("eval/") && !name.contains("/checkpoints/")
            });
            files
        };
        let (files, expected) = (compared(run), compared(other));
        assert!(files.keys().eq(expected.keys()), "{:?} is not {:?}", files.keys(), expected.keys());
        for (name, bytes) in &files {
            assert!(*bytes == expected[name], "{} of {run} and {other} differs", name.display());
        }
        for stage in ["stage1", "stage2"] {
            assert_eq!(self.progress(run, stage), self.progress(other, stage), "{stage}");
        }
        assert_eq!(self.summary_but_time(run), self.summary_but_time(other));
    }

    pub fn summary_but_time(&self, run: &str) -> Value {
        let mut summary = self.json(&format!("{run}/eval/summary.json"));
        for point in summary["points"].as_array_mut().expect("a list") {
            let point = point.as_object_mut().expect("an object");
            point.retain(|key, _| !key.ends_with("_s") && key != "peak_bytes" && key != "pareto_time");
        }
        summary
    }

    #[track_caller]
    pub fn names(&self, folder: &str) -> Vec<String> {
        let items = std::fs::read_dir(self.at(folder)).unwrap_or_else(|error| panic!("{folder}: {error}"));
        let name = |item: std::io::Result<std::fs::DirEntry>| item.expect("readable").file_name().into_string();
        let mut names: Vec<_> = items.map(|item| name(item).expect("text")).collect();
        names.sort();
        names
    }

    pub fn checkpoints(&self, run: &str, stage: &str) -> Vec<u64> {
        let names = self.names(&format!("{run}/{stage}/checkpoints"));
        let step = |name: &String| name.strip_prefix("step-").and_then(|step| step.parse().ok());
        names.iter().map(|name| step(name).expect(name)).collect()
    }

    /// Expects a message that ends with the last good checkpoint of stage 1, the only one there is.
    #[track_caller]
    pub fn assert_names_last_checkpoint(&self, run: &str, step: u64, message: &str) {
        let checkpoint = self.at(&format!("{run}/stage1/checkpoints/step-{step:09}"));
        let end = format!("the last good checkpoint is {}", checkpoint.display());
        assert!(message.trim_end().ends_with(&end), "{message}");
        assert_eq!(self.checkpoints(run, "stage1"), [step], "nothing half-written lies beside it");
    }

    /// The progress in the last checkpoint of a stage.
    pub fn progress(&self, run: &str, stage: &str) -> Value {
        let step = *self.checkpoints(run, stage).last().expect("a checkpoint");
        self.json(&format!("{run}/{stage}/checkpoints/step-{step:09}/state.json"))["progress"].take()
    }

    pub fn points(&self, eval: &str) -> Vec<Value> {
        list(&self.json(&format!("{eval}/summary.json"))["points"]).to_vec()
    }

    pub fn write(&self, name: &str, text: impl AsRef<[u8]>) {
        let path = self.at(name);
        std::fs::create_dir_all(path.parent().expect("a folder")).expect("writable");
        std::fs::write(path, text).expect("writable");
    }

    /// Cuts a file in half.
    pub fn truncate(&self, name: &str) {
        let bytes = self.bytes(name);
        std::fs::write(self.at(name), &bytes[..bytes.len() / 2]).expect("writable");
    }
}

#[track_caller]
pub fn list(value: &Value) -> &[Value] {
    value.as_array().unwrap_or_else(|| panic!("{value} is not a list"))
}

#[track_caller]
pub fn number(value: &Value, key: &str) -> f64 {
    value[key].as_f64().unwrap_or_else(|| panic!("{key} is not a number: {value}"))
}

/// The first of these points of an evaluation with this method and number of tokens.
#[track_caller]
pub fn point<'a>(points: impl IntoIterator<Item = &'a Value>, variant: &str, num_storage_tokens: usize) -> &'a Value {
    let is_it = |point: &&Value| point["method"] == variant && point["num_storage_tokens"] == num_storage_tokens;
    points.into_iter().find(is_it).unwrap_or_else(|| panic!("no {variant} of {num_storage_tokens} tokens"))
}

pub fn copy_folder(from: &Path, to: &Path) {
    for (path, bytes) in files(from) {
        let to = to.join(path);
        std::fs::create_dir_all(to.parent().expect("a folder")).expect("writable");
        std::fs::write(to, bytes).expect("writable");
    }
}

/// Every file below a folder by its path in it.
pub fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    for item in std::fs::read_dir(folder).expect("a folder") {
        let path = item.expect("readable").path();
        let name = Path::new(path.file_name().expect("named"));
        if path.is_dir() {
            found.extend(files(&path).into_iter().map(|(below, bytes)| (name.join(below), bytes)));
        } else {
            found.insert(name.to_owned(), std::fs::read(&path).expect("readable"));
        }
    }
    found
}

/// Texts of the repository's files with these endings below some folders, by their paths in it.
pub fn sources(folders: &[&str], endings: &[&str]) -> BTreeMap<String, String> {
    let has_ending = |path: &Path| path.extension().is_some_and(|ending| endings.iter().any(|one| ending == *one));
    let mut found = BTreeMap::new();
    for folder in folders {
        let files = files(&repository(folder)).into_iter().filter(|(path, _)| has_ending(path));
        found.extend(files.map(|(path, bytes)| {
            let text = String::from_utf8(bytes).expect("sources are UTF-8");
            (format!("{folder}/{}", path.display()), text)
        }));
    }
    found
}

#[derive(Clone, Debug, PartialEq)]
pub struct Weights(pub BTreeMap<String, Vec<f32>>);

impl Weights {
    /// Reads a weight file. Files of equal weights differ in bytes: Burn writes the header's metadata in any order.
    fn read(bytes: &[u8]) -> Self {
        let file = safetensors::SafeTensors::deserialize(bytes).expect("valid safetensors");
        let values = |data: &[u8]| data.as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
        let tensors = file.tensors().into_iter().map(|(name, view)| {
            assert_eq!(view.dtype(), safetensors::Dtype::F32, "{name}");
            (name, values(view.data()))
        });
        Self(tensors.collect())
    }

    pub fn part(&self, prefix: &str) -> Self {
        let part: BTreeMap<_, _> = self.0.clone().into_iter().filter(|(name, _)| name.starts_with(prefix)).collect();
        assert!(!part.is_empty(), "no parameter starts with {prefix}");
        Self(part)
    }

    /// Differences of all values from those of the same model.
    pub fn moved_from<'a>(&'a self, other: &'a Self) -> impl Iterator<Item = f64> + 'a {
        assert!(self.0.keys().eq(other.0.keys()), "two models");
        let pairs = self.0.iter().flat_map(|(name, values)| values.iter().zip(&other.0[name]));
        pairs.map(|(a, b)| (f64::from(*a) - f64::from(*b)).abs())
    }
}
