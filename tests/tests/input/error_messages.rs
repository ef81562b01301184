//! Error messages of wrong input, one file of `tests/snapshots` each. `CLIFT_UPDATE_SNAPSHOTS=1 cargo test` rewrites
//! them; read the difference before you commit it.

use std::process::Command;

use crate::support::{BINARY, Place, Ran, finish, repository, start};

const RIGHT: &str = include_str!("../../snapshots/right.toml");

/// Name, replaced text of the config (where it is first), and replacement.
const CONFIGS: [(&str, &str, &str); 34] = [
    ("unknown-key", "dim = 16", "dimm = 16"),
    ("unknown-section", "[clusters]", "[cluster]"),
    ("key-of-another-section", "num_heads = 2", "num_heads = 2\nbatch_size = 4"),
    ("key-that-is-nothing", "num_heads = 2", "num_heads = 2\nquark = 4"),
    ("text-for-a-number", "steps = 6", "steps = \"ten\""),
    ("negative-count", "steps = 6", "steps = -3"),
    ("fraction-for-a-count", "dim = 16", "dim = 16.5"),
    ("number-for-a-section", "[stage2]\nsteps = 4\nbatch_size = 2", "[eval.index]\nx = 1"),
    ("unknown-choice", "\"synthetic\"", "\"synthetik\""),
    ("unknown-device", "\"flex\"", "\"cuda\""),
    ("missing-key", "run_dir = \"DIR/run\"\n", ""),
    ("empty-run-dir", "DIR/run", ""),
    ("not-toml", "dim = 16", "dim = sixteen"),
    ("key-twice", "dim = 16", "dim = 16\ndim = 32"),
    ("heads-do-not-divide-the-width", "num_heads = 2", "num_heads = 3"),
    ("no-heads", "num_heads = 2", "num_heads = 0"),
    ("patches-do-not-divide-the-width", "width = 16", "width = 20"),
    ("patch-beyond-the-picture", "patch_size = 8", "patch_size = 32"),
    ("number-beyond-64-bits", "steps = 6", "steps = 99999999999999999999"),
    ("batch-beyond-the-limit", "batch_size = 2\naccumulate", "batch_size = 1000000\naccumulate"),
    ("no-batch", "batch_size = 2\naccumulate", "batch_size = 0\naccumulate"),
    ("more-parts-than-scenes", "accumulate = 1", "accumulate = 3"),
    ("count-beyond-the-tokens", "grid = [0.5, 1.0]", "grid = [0.5, 9]"),
    ("share-beyond-one", "grid = [0.5, 1.0]", "grid = [0.5, 1.5]"),
    ("share-that-is-no-number", "grid = [0.5, 1.0]", "grid = [\"1/0\"]"),
    ("empty-grid", "grid = [0.5, 1.0]", "grid = []"),
    ("range-the-wrong-way-round", "keep_tokens = [0.25, 1.0]", "keep_tokens = [1.0, 0.25]"),
    ("range-of-three", "keep_tokens = [0.25, 1.0]", "keep_tokens = [0.1, 0.5, 1.0]"),
    ("learning-rate-nan", "learning_rate = 1e-3", "learning_rate = nan"),
    ("one-context", "min_context = 2", "min_context = 1"),
    ("fewer-contexts-than-the-least", "max_context = 2", "max_context = 1"),
    ("gap-the-wrong-way-round", "min_gap = [3, 3]", "min_gap = [5, 3]"),
    ("chunks-without-a-folder", "\"synthetic\"", "\"chunks\""),
    ("views-larger-than-the-scenes", "width = 16", "width = 32"),
];

/// Name and `--set` for the valid config.
const OVERRIDES: [(&str, &str); 11] = [
    ("synthetic-scenes-with-a-folder", "data.root=\"photos\""),
    ("override-without-a-value", "stage1.steps"),
    ("override-of-an-unknown-key", "stage1.step=3"),
    ("override-by-initials", "stage1.lr=1e-3"),
    ("override-by-a-word", "data.synthetic.max_fov=90"),
    ("override-below-a-value", "stage1.steps.x=3"),
    ("override-of-another-type", "stage1.steps=ten"),
    ("override-beyond-a-limit", "data.synthetic.fov_deg=180.0"),
    ("override-that-is-not-toml", "device=a b"),
    ("override-with-another-type-in-a-list", "clusters.grid=[0.5, true]"),
    ("override-that-contradicts-the-file", "model.dim=15"),
];

/// Name and command line.
const COMMANDS: [(&str, &str); 6] = [
    ("no-such-config", "train DIR/nothing.toml"),
    ("no-such-stage", "train DIR/right.toml --only stage3"),
    ("no-such-device", "train DIR/right.toml --device gpu"),
    ("no-such-work", "bench DIR/right.toml --case incode"),
    ("no-such-run", "eval DIR/nothing"),
    ("no-such-command", "tarin DIR/right.toml"),
];

#[test]
fn every_wrong_input_gives_its_message() {
    let place = Place::new();
    let dir = place.at("").display().to_string().trim_end_matches('/').to_owned();
    let right = RIGHT.replace("DIR", &dir);
    place.write("right.toml", &right);
    let mut differing = Vec::new();
    for (name, from, to) in CONFIGS {
        assert!(RIGHT.contains(from), "{name}: the config does not hold {from}");
        place.write("wrong.toml", RIGHT.replacen(from, to, 1).replace("DIR", &dir));
        differing.extend(differs(name, &place.clift("train DIR/wrong.toml"), &dir));
        assert!(!place.at("run").exists(), "{name}: a refused config leaves nothing behind");
    }
    let config = place.at("right.toml").display().to_string();
    for (name, set) in OVERRIDES {
        let ran = finish(start(Command::new(BINARY).args(["train", &config, "--set", set])));
        differing.extend(differs(name, &ran, &dir));
        assert!(!place.at("run").exists(), "{name}: a refused override leaves nothing behind");
    }
    for (name, words) in COMMANDS {
        differing.extend(differs(name, &place.clift(words), &dir));
    }
    assert!(differing.is_empty(), "{}", differing.join("\n\n"));
}

/// Compares an error with its snapshot, or writes the snapshot if `CLIFT_UPDATE_SNAPSHOTS` is set.
fn differs(name: &str, ran: &Ran, dir: &str) -> Option<String> {
    let code = ran.code.map_or_else(|| "none".into(), |code| code.to_string());
    let said = format!("exit code {code}\n{}", ran.stderr.replace(dir, "DIR"));
    assert!(!said.contains("panicked"), "{name}: {said}");
    let path = repository("tests/snapshots").join(format!("{name}.txt"));
    if std::env::var_os("CLIFT_UPDATE_SNAPSHOTS").is_some() {
        std::fs::write(&path, said).expect("the repository is writable");
        return None;
    }
    let expected = std::fs::read_to_string(&path).unwrap_or_default();
    (said != expected).then(|| format!("{name}\nexpected:\n{expected}\ngot:\n{said}"))
}
