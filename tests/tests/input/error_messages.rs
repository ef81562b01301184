//! What is said of wrong input: one file of `tests/snapshots` each. `CLIFT_UPDATE_SNAPSHOTS=1 cargo test` writes them
//! anew; read what changed before it is committed.

use std::path::Path;

use crate::support::{Place, Ran, clift, repository};

/// A config in which nothing is wrong.
const RIGHT: &str = "\
run_dir = \"DIR/run\"
device = \"flex\"

[data]
source = \"synthetic\"
width = 16
height = 16

[data.synthetic]
num_scenes = 8
num_frames = 8
width = 16
height = 16

[data.views]
min_context = 2
max_context = 2
min_gap = [3, 3]
max_gap = [6, 6]
num_targets = 2

[model]
dim = 16
num_heads = 2
feed_forward_dim = 24
num_encoder_blocks = 1
num_renderer_blocks = 1
patch_size = 8

[stage1]
steps = 6
batch_size = 2
accumulate = 1
keep_tokens = [0.25, 1.0]
optimizer = { learning_rate = 1e-3, warm_up_steps = 2 }

[clusters]
grid = [0.5, 1.0]
num_passes = 1

[stage2]
steps = 4
batch_size = 2

[eval]
storage = [0.5, 1.0]
num_context = 2
num_targets = 2
";

/// Name, what is replaced in the config by what, and arguments behind `train CONFIG`.
const CONFIGS: [(&str, &str, &str, &[&str]); 40] = [
    ("unknown-key", "dim = 16", "dimm = 16", &[]),
    ("unknown-section", "[clusters]", "[cluster]", &[]),
    ("key-of-another-section", "num_heads = 2", "num_heads = 2\nbatch_size = 4", &[]),
    ("key-that-is-nothing", "num_heads = 2", "num_heads = 2\nquark = 4", &[]),
    ("text-for-a-number", "steps = 6", "steps = \"ten\"", &[]),
    ("negative-count", "steps = 6", "steps = -3", &[]),
    ("fraction-for-a-count", "dim = 16", "dim = 16.5", &[]),
    ("number-for-a-section", "[stage2]\nsteps = 4\nbatch_size = 2", "[eval.index]\nx = 1", &[]),
    ("unknown-choice", "\"synthetic\"", "\"synthetik\"", &[]),
    ("unknown-device", "\"flex\"", "\"cuda\"", &[]),
    ("missing-key", "run_dir = \"DIR/run\"\n", "", &[]),
    ("empty-run-dir", "DIR/run", "", &[]),
    ("not-toml", "dim = 16", "dim = sixteen", &[]),
    ("key-twice", "dim = 16", "dim = 16\ndim = 32", &[]),
    ("heads-do-not-divide-the-width", "num_heads = 2", "num_heads = 3", &[]),
    ("no-heads", "num_heads = 2", "num_heads = 0", &[]),
    (
        "patches-do-not-divide-the-width",
        "width = 16\nheight = 16\n\n[data.synthetic]",
        "width = 20\nheight = 16\n\n[data.synthetic]",
        &[],
    ),
    ("patch-beyond-the-picture", "patch_size = 8", "patch_size = 32", &[]),
    ("no-batch", "batch_size = 2\naccumulate", "batch_size = 0\naccumulate", &[]),
    ("more-parts-than-scenes", "accumulate = 1", "accumulate = 3", &[]),
    ("count-beyond-the-tokens", "grid = [0.5, 1.0]", "grid = [0.5, 9]", &[]),
    ("share-beyond-one", "grid = [0.5, 1.0]", "grid = [0.5, 1.5]", &[]),
    ("share-that-is-no-number", "grid = [0.5, 1.0]", "grid = [\"1/0\"]", &[]),
    ("empty-grid", "grid = [0.5, 1.0]", "grid = []", &[]),
    ("range-the-wrong-way-round", "keep_tokens = [0.25, 1.0]", "keep_tokens = [1.0, 0.25]", &[]),
    ("range-of-three", "keep_tokens = [0.25, 1.0]", "keep_tokens = [0.1, 0.5, 1.0]", &[]),
    ("learning-rate-nan", "learning_rate = 1e-3", "learning_rate = nan", &[]),
    ("one-context", "min_context = 2", "min_context = 1", &[]),
    ("fewer-contexts-than-the-least", "max_context = 2", "max_context = 1", &[]),
    ("gap-the-wrong-way-round", "min_gap = [3, 3]", "min_gap = [5, 3]", &[]),
    ("chunks-without-a-folder", "\"synthetic\"", "\"chunks\"", &[]),
    (
        "views-larger-than-the-scenes",
        "width = 16\nheight = 16\n\n[data.synthetic]",
        "width = 32\nheight = 16\n\n[data.synthetic]",
        &[],
    ),
    ("override-without-a-value", "", "", &["--set", "stage1.steps"]),
    ("override-of-an-unknown-key", "", "", &["--set", "stage1.step=3"]),
    ("override-below-a-value", "", "", &["--set", "stage1.steps.x=3"]),
    ("override-of-another-type", "", "", &["--set", "stage1.steps=ten"]),
    ("override-beyond-a-limit", "", "", &["--set", "data.synthetic.fov_deg=180.0"]),
    ("override-that-is-not-toml", "", "", &["--set", "device=a b"]),
    ("override-with-another-type-in-a-list", "", "", &["--set", "clusters.grid=[0.5, true]"]),
    ("override-that-contradicts-the-file", "", "", &["--set", "model.dim=15"]),
];

/// Name and arguments.
const COMMANDS: [(&str, &[&str]); 6] = [
    ("no-such-config", &["train", "DIR/nothing.toml"]),
    ("no-such-stage", &["train", "DIR/right.toml", "--only", "stage3"]),
    ("no-such-device", &["train", "DIR/right.toml", "--device", "gpu"]),
    ("no-such-work", &["bench", "DIR/right.toml", "--work", "incode"]),
    ("no-such-run", &["eval", "DIR/nothing"]),
    ("no-such-command", &["tarin", "DIR/right.toml"]),
];

#[test]
fn every_wrong_input_gives_its_message() {
    let place = Place::new();
    let dir = place.at("").display().to_string().trim_end_matches('/').to_owned();
    let right = RIGHT.replace("DIR", &dir);
    std::fs::write(place.at("right.toml"), &right).unwrap();
    let mut differing = Vec::new();
    for (name, from, to, flags) in CONFIGS {
        assert!(RIGHT.contains(from), "{name}: the config does not hold {from}");
        std::fs::write(place.at("wrong.toml"), RIGHT.replacen(from, to, 1).replace("DIR", &dir)).unwrap();
        let config = place.at("wrong.toml").display().to_string();
        let ran = clift(["train", &config].iter().chain(flags));
        differing.extend(differs(name, &ran, &dir));
        assert!(!place.at("run").exists(), "{name}: a refused config leaves nothing behind");
    }
    for (name, args) in COMMANDS {
        let ran = clift(args.iter().map(|arg| arg.replace("DIR", &dir)));
        differing.extend(differs(name, &ran, &dir));
    }
    assert!(differing.is_empty(), "{}", differing.join("\n\n"));
}

/// How an error differs from its snapshot, which is written where that is asked for.
fn differs(name: &str, ran: &Ran, dir: &str) -> Option<String> {
    let code = ran.code.map_or_else(|| "none".into(), |code| code.to_string());
    let said = format!("exit code {code}\n{}", ran.stderr.replace(dir, "DIR"));
    assert!(!said.contains("panicked"), "{name}: {said}");
    let path = repository("tests/snapshots").join(format!("{name}.txt"));
    if std::env::var_os("CLIFT_UPDATE_SNAPSHOTS").is_some() {
        write(&path, &said);
        return None;
    }
    let expected = std::fs::read_to_string(&path).unwrap_or_default();
    (said != expected).then(|| format!("{name}\nexpected:\n{expected}\ngot:\n{said}"))
}

fn write(path: &Path, text: &str) {
    std::fs::create_dir_all(path.parent().expect("it lies in a folder")).expect("the repository is writable");
    std::fs::write(path, text).expect("the repository is writable");
}

#[test]
fn an_instruction_set_that_is_none_is_refused() {
    let place = Place::new();
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_clift-under-test"));
    command.args(place.train_args("run", &[], &[])).env("CLIFT_INSTRUCTION_SET", "avx9");
    let output = command.output().expect("the binary under test starts");
    let message = String::from_utf8(output.stderr).expect("it prints UTF-8");
    assert_eq!(output.status.code(), Some(2), "{message}");
    assert!(message.contains("`CLIFT_INSTRUCTION_SET` = avx9: unknown instruction set; use one of "), "{message}");
    assert!(!place.at("run").exists());
}

#[test]
fn plans_name_wrong_values_and_need_no_data() {
    let place = Place::new();
    let config = repository("configs/re10k.toml").display().to_string();
    let plan = |flags: &[&str]| {
        let fixed = ["plan", &config, "--no-time", "--device", "flex", "--set", "loss.perceptual_weight=0.0"];
        clift(fixed.iter().chain(flags))
    };
    plan(&["--set", "model.num_heads=7"])
        .fails_with(2, &["`model.num_heads` = 7: write a divisor of model.dim = 768, such as 6 or 8"]);
    let json = place.at("plan.json").display().to_string();
    plan(&["--json", &json]).ok();
    let plan = place.json("plan.json");
    let trained = plan["parts"][0]["trained_parameters"].as_u64();
    assert_eq!(trained, Some(81_239_232));
    assert!(plan["parts"][0]["seconds"].is_null());
}
