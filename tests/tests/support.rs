//! Runs the command line in temporary folders and reads the files of the runs.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use serde_json::Value;
use tempfile::TempDir;

/// The smallest run that has everything: two 16 x 16 views of 4 tokens each, 8 rooms, a fraction of a second.
///
/// Replaces every section, so that changes of `configs/tiny.toml` do not affect these tests.
const MICRO: [&str; 9] = [
    "seed=0",
    "device=flex",
    "data={source='synthetic', width=16, height=16, \
        synthetic={num_scenes=8, num_frames=8, width=16, height=16, samples_per_pixel=1}, \
        views={min_context=2, max_context=2, min_gap=[3, 3], max_gap=[6, 6], warm_up_steps=0, num_targets=2}}",
    "model={dim=16, num_heads=2, feed_forward_dim=24, num_encoder_blocks=1, num_renderer_blocks=1, \
        condenser={num_blocks=1}}",
    "stage1={steps=6, batch_size=2, optimizer={learning_rate=1e-3, warm_up_steps=2}}",
    "clusters={grid=[0.5, 1.0], num_passes=1, num_scenes=6}",
    "stage2={steps=4, batch_size=2, optimizer={learning_rate=1e-3, warm_up_steps=1}}",
    "checkpoint={every=2, keep=2}",
    "eval={storage=[0.5, 1.0], num_scenes=3, num_context=2, num_targets=2, num_sheets=1, every=3, \
        num_validation_scenes=1}",
];

/// A file of the repository.
pub fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("tests/ lies in the repository").join(path)
}

/// Exit code and output of a command.
#[derive(Debug)]
pub struct Ran {
    pub code: Option<i32>,
    pub stdout: String,
    pub stderr: String,
}

impl Ran {
    /// Expects success.
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

    /// Expects this exit code and these parts of the error.
    #[track_caller]
    pub fn fails_with(self, code: i32, parts: &[&str]) {
        let message = self.fails(code);
        for part in parts {
            assert!(message.contains(part), "{part}\nis not in\n{message}");
        }
    }
}

/// Runs the command line to its end.
pub fn clift<S: AsRef<std::ffi::OsStr>>(args: impl IntoIterator<Item = S>) -> Ran {
    finish(spawn(args))
}

/// Starts the command line.
pub fn spawn<S: AsRef<std::ffi::OsStr>>(args: impl IntoIterator<Item = S>) -> Child {
    start(Command::new(BINARY).args(args))
}

/// The command line as a program.
pub const BINARY: &str = env!("CARGO_BIN_EXE_clift-under-test");

/// Starts a command that [`finish`] waits for.
pub fn start(command: &mut Command) -> Child {
    let piped = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    piped.spawn().expect("the binary under test starts")
}

/// Runs a training that must kill itself at `moment` (see `clift-killed`).
pub fn killed_at(moment: &str, args: &[String]) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_clift-killed"));
    let ran = finish(start(command.arg(moment).args(args)));
    assert_eq!(ran.code, None, "{moment}: stdout:\n{}\nstderr:\n{}", ran.stdout, ran.stderr);
}

/// Sends a signal to a command.
pub fn signal(child: &Child, name: &str) {
    let sent = Command::new("kill").args([name, &child.id().to_string()]).status().expect("kill runs");
    assert!(sent.success(), "the run is still there to be stopped");
}

/// Waits until a run has made `count` steps.
pub fn wait_for_steps(run: &Path, child: &mut Child, count: usize) {
    let started = Instant::now();
    loop {
        let text = std::fs::read_to_string(run.join("metrics.jsonl")).unwrap_or_default();
        if text.lines().count() >= count {
            return;
        }
        assert!(child.try_wait().expect("a child").is_none(), "the run ended before step {count}");
        assert!(started.elapsed() < Duration::from_mins(1), "no step {count} within a minute");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Waits for a command.
pub fn finish(child: Child) -> Ran {
    let output = child.wait_with_output().expect("the binary under test ends");
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).expect("it prints UTF-8");
    Ran { code: output.status.code(), stdout: text(output.stdout), stderr: text(output.stderr) }
}

/// A micro run that several tests copy, trained once.
pub struct Shared {
    set: &'static [&'static str],
    flags: &'static [&'static str],
    files: OnceLock<BTreeMap<PathBuf, Vec<u8>>>,
}

/// The whole micro run, with its evaluation.
pub static WHOLE: Shared = Shared::new(&[], &[]);
/// Its first stage.
pub static STAGE_1: Shared = Shared::new(&[], &["--only", "stage1"]);

impl Shared {
    /// The micro run with changed keys and further flags.
    pub const fn new(set: &'static [&'static str], flags: &'static [&'static str]) -> Self {
        Self { set, flags, files: OnceLock::new() }
    }
}

/// A temporary folder for runs.
pub struct Place(TempDir);

impl Place {
    pub fn new() -> Self {
        Self(tempfile::tempdir().expect("a temporary folder"))
    }

    /// Path of an item of the folder.
    pub fn at(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// Arguments that train the micro run `name` with changed keys and further flags.
    pub fn train_args(&self, name: &str, set: &[&str], flags: &[&str]) -> Vec<String> {
        let mut args = vec!["train".into(), repository("configs/tiny.toml").display().to_string()];
        let run_dir = format!("run_dir=\"{}\"", self.at(name).display());
        for text in MICRO.iter().chain(&[run_dir.as_str()]).chain(set) {
            args.extend(["--set".into(), (*text).into()]);
        }
        args.extend(flags.iter().map(|&flag| flag.into()));
        args
    }

    /// Trains the micro run `name` to its end.
    pub fn train(&self, name: &str, set: &[&str], flags: &[&str]) -> Ran {
        clift(self.train_args(name, set, flags))
    }

    /// Copies a shared run to `name`, as if it had been trained here.
    pub fn copy(&self, shared: &Shared, name: &str) {
        // The only file that holds the path of its run.
        let config = Path::new("config.toml");
        let moved = |bytes: &[u8], from: &Path, to: &Path| {
            let text = String::from_utf8(bytes.to_vec()).expect("text");
            text.replace(&from.display().to_string(), &to.display().to_string()).into_bytes()
        };
        let files = shared.files.get_or_init(|| {
            let place = Self::new();
            place.train("run", shared.set, shared.flags).ok();
            let run = place.at("run");
            let relative = |path: &Path| path.strip_prefix(&run).expect("below").to_owned();
            let mut found: BTreeMap<_, _> =
                files(&run).into_iter().map(|(path, bytes)| (relative(&path), bytes)).collect();
            let text = found.get_mut(config).expect("a config");
            *text = moved(text, &run, Path::new("RUN"));
            found
        });
        for (path, bytes) in files {
            let to = self.at(name).join(path);
            std::fs::create_dir_all(to.parent().expect("a folder")).expect("writable");
            let run = self.at(name);
            let moved = (path == config).then(|| moved(bytes, Path::new("RUN"), &run));
            std::fs::write(to, moved.as_ref().unwrap_or(bytes)).expect("writable");
        }
    }

    /// Runs the command line with the words of a text, where `DIR` is the folder and `REPO` the repository.
    pub fn clift(&self, words: &str) -> Ran {
        let (dir, repository) = (self.at("").display().to_string(), repository("").display().to_string());
        let path = |word: &str| word.replace("DIR/", &dir).replace("REPO/", &repository);
        clift(words.split_whitespace().map(path))
    }

    /// Evaluates the run `name`.
    pub fn eval(&self, name: &str, flags: &[&str]) -> Ran {
        let run = self.at(name).display().to_string();
        clift(["eval", &run].iter().chain(flags))
    }

    /// Reads a file of the folder.
    pub fn bytes(&self, name: &str) -> Vec<u8> {
        std::fs::read(self.at(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
    }

    /// Reads a text file of the folder.
    pub fn text(&self, name: &str) -> String {
        String::from_utf8(self.bytes(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
    }

    /// Reads a JSON file of the folder.
    pub fn json(&self, name: &str) -> Value {
        serde_json::from_slice(&self.bytes(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
    }

    /// The lines of a run's `metrics.jsonl`.
    pub fn metrics(&self, run: &str) -> Vec<Value> {
        let text = self.text(&format!("{run}/metrics.jsonl"));
        text.lines().map(|line| serde_json::from_str(line).unwrap_or_else(|error| panic!("{line}: {error}"))).collect()
    }

    /// The lines of a run's `metrics.jsonl` without times.
    pub fn metrics_but_time(&self, run: &str) -> Vec<Value> {
        let mut lines = self.metrics(run);
        for line in &mut lines {
            line.as_object_mut().expect("an object").remove("step_s");
        }
        lines
    }

    /// The weights of a stage of a run.
    pub fn weights(&self, run: &str, stage: &str) -> Weights {
        Weights::read(&self.at(&format!("{run}/{stage}/model.safetensors")))
    }

    /// The weights of a model directory.
    pub fn model(&self, name: &str) -> Weights {
        Weights::read(&self.at(&format!("{name}/model.safetensors")))
    }

    /// Expects the same clusters and the same weights of both stages, bit for bit.
    pub fn assert_same_result(&self, run: &str, other: &str) {
        for stage in ["stage1", "stage2"] {
            assert!(self.weights(run, stage) == self.weights(other, stage), "{stage} of {run} and {other} differs");
        }
        for file in ["clusters/index.json", "clusters/clusters.bin"] {
            let same = self.bytes(&format!("{run}/{file}")) == self.bytes(&format!("{other}/{file}"));
            assert!(same, "{file} of {run} and {other} differs");
        }
    }

    /// Expects the same files but for times: weights, clusters, metrics, skipped steps, samples, the progress in the last
    /// checkpoints, and the evaluation.
    pub fn assert_same_run(&self, run: &str, other: &str) {
        assert_eq!(self.metrics_but_time(run), self.metrics_but_time(other), "no step is missing or doubled");
        let compared = |run: &str| {
            let mut files = files(&self.at(run));
            // The report holds the date, `views.csv` times, and `config.toml` the path of its run.
            let is_result = |path: &Path| {
                let name = path.strip_prefix(self.at(run)).expect("below").display().to_string();
                let (others, progress) = (["metrics.jsonl", "config.toml", "lock"], name.contains("/checkpoints/"));
                !(others.contains(&name.as_str()) || name.starts_with("eval/") || progress)
            };
            files.retain(|path, _| is_result(path));
            let name = |path: PathBuf| path.strip_prefix(self.at(run)).expect("below").to_owned();
            files.into_iter().map(|(path, bytes)| (name(path), bytes)).collect::<BTreeMap<_, _>>()
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

    /// A run's `summary.json` without times.
    pub fn summary_but_time(&self, run: &str) -> Value {
        let mut summary = self.json(&format!("{run}/eval/summary.json"));
        for point in summary["points"].as_array_mut().expect("a list") {
            let point = point.as_object_mut().expect("an object");
            point.retain(|key, _| !key.ends_with("_s") && key != "peak_bytes" && key != "pareto_time");
        }
        summary
    }

    /// The steps of a stage's checkpoints.
    pub fn checkpoints(&self, run: &str, stage: &str) -> Vec<u64> {
        let folder = std::fs::read_dir(self.at(&format!("{run}/{stage}/checkpoints"))).expect("a folder");
        let name = |item: std::io::Result<std::fs::DirEntry>| item.expect("readable").file_name().into_string();
        let step = |name: String| name.strip_prefix("step-").and_then(|step| step.parse().ok());
        let mut steps: Vec<u64> =
            folder.map(|item| name(item).expect("text")).map(|name| step(name.clone()).expect(&name)).collect();
        steps.sort_unstable();
        steps
    }

    /// The progress in the last checkpoint of a stage.
    pub fn progress(&self, run: &str, stage: &str) -> Value {
        let step = *self.checkpoints(run, stage).last().expect("a checkpoint");
        self.json(&format!("{run}/{stage}/checkpoints/step-{step:09}/state.json"))["progress"].take()
    }

    /// Cuts a file in half.
    pub fn truncate(&self, name: &str) {
        let bytes = self.bytes(name);
        std::fs::write(self.at(name), &bytes[..bytes.len() / 2]).expect("writable");
    }
}

/// Copies a folder with everything in it.
pub fn copy_folder(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).expect("writable");
    for item in std::fs::read_dir(from).expect("a folder") {
        let item = item.expect("readable").path();
        let name = to.join(item.file_name().expect("named"));
        if item.is_dir() {
            copy_folder(&item, &name);
        } else {
            std::fs::copy(&item, &name).expect("writable");
        }
    }
}

/// Every file below a folder, with its bytes.
pub fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    for item in std::fs::read_dir(folder).expect("a folder") {
        let path = item.expect("readable").path();
        if path.is_dir() {
            found.extend(files(&path));
        } else {
            found.insert(path.clone(), std::fs::read(&path).expect("readable"));
        }
    }
    found
}

/// Texts of the repository's files with these endings below some folders, by their paths in it.
pub fn sources(folders: &[&str], endings: &[&str]) -> BTreeMap<String, String> {
    let root = repository("");
    let all = folders.iter().flat_map(|folder| files(&repository(folder)));
    let has_ending = |path: &Path| path.extension().is_some_and(|ending| endings.iter().any(|one| ending == *one));
    let text = |(path, bytes): (PathBuf, Vec<u8>)| {
        let name = path.strip_prefix(&root).expect("a file of the repository").display().to_string();
        (name, String::from_utf8(bytes).expect("sources are UTF-8"))
    };
    all.filter(|(path, _)| has_ending(path)).map(text).collect()
}

/// Parameters by name.
#[derive(Clone, Debug, PartialEq)]
pub struct Weights(pub BTreeMap<String, Vec<f32>>);

impl Weights {
    /// Reads a weight file. Files of equal weights differ in bytes: Burn writes the header's metadata in any order.
    fn read(path: &Path) -> Self {
        let bytes = std::fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        let file = safetensors::SafeTensors::deserialize(&bytes).expect("valid safetensors");
        let values = |data: &[u8]| data.as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
        let tensors = file.tensors().into_iter().map(|(name, view)| {
            assert_eq!(view.dtype(), safetensors::Dtype::F32, "{name}");
            (name, values(view.data()))
        });
        Self(tensors.collect())
    }

    /// The parameters of one network.
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
