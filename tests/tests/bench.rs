//! `clift bench`: the rows it prints and the file it writes.

use std::io::{BufRead, BufReader};

use crate::support::{Place, finish, list, number, signal};

const ROWS: &str = "encode kmeans condense cluster_attention select code_tokens decode_tokens render render_8_views stage1_step \
    stage1_step_tiny stage2_step";

/// Times a network that takes milliseconds.
const BENCH: &str = "bench REPO/tests/micro.toml";

#[test]
fn every_row_has_its_time_and_error() {
    let place = Place::new();
    let ran = place.clift(&format!("{BENCH} --repeats 2 --warmup 0 --json DIR/bench.json")).ok();
    for work in ROWS.split(' ') {
        assert!(ran.stdout.lines().any(|line| line.starts_with(&format!("{work}  "))), "{work}: {}", ran.stdout);
        assert!(ran.stderr.lines().any(|line| line.starts_with(&format!("{work}: "))), "{work}: {}", ran.stderr);
    }
    let report = place.json("bench.json");
    assert_eq!(report["device"], "flex");
    assert!(report["threads"].as_u64().is_some_and(|threads| threads > 0));
    let rows = list(&report["rows"]);
    let names: Vec<&str> = rows.iter().map(|row| row["case"].as_str().expect("a name")).collect();
    assert_eq!(names.join(" "), ROWS);
    for row in rows {
        assert!(number(row, "median_s") > 0.0 && number(row, "p95_s") >= number(row, "median_s"), "{row}");
        assert_eq!(list(&row["samples_s"]).len(), 2, "{row}");
        // f32 through one or two blocks; f32 compared with itself would give exactly 0 everywhere.
        // Selection gives ids, and the coder rounds: they have no error.
        let has_none = ["select", "code_tokens", "decode_tokens"].iter().any(|name| row["case"] == *name);
        assert_eq!(row["max_rel_error"].is_null(), has_none, "{row}");
        assert!(row["max_rel_error"].is_null() || number(row, "max_rel_error") < 1e-4, "{row}");
        let peak = &row["peak_bytes"];
        assert!(peak.is_null() || peak.as_u64().is_some_and(|bytes| bytes > 1 << 20), "{row}");
        assert_eq!(row.get("inertia").is_some(), row["case"] == "kmeans", "{row}");
    }
    let exact = rows.iter().filter(|row| row["max_rel_error"] == 0.0 && row["case"] != "kmeans").count();
    assert_eq!(exact, 0, "{rows:?}");
}

#[test]
fn rows_are_chosen_and_errors_omitted_on_request() {
    let place = Place::new();
    place.clift(&format!("{BENCH} --case render,encode --no-error --repeats 1 --json DIR/bench.json")).ok();
    let rows = &place.json("bench.json")["rows"];
    assert_eq!((&rows[0]["case"], &rows[1]["case"]), (&"encode".into(), &"render".into()));
    assert!(list(rows).iter().all(|row| row["max_rel_error"].is_null()));
}

#[test]
fn what_cannot_be_timed_is_wrong_usage() {
    let place = Place::new();
    for (flags, expected) in [
        ("--case encode,incode", &["'incode'", "the cases are encode, kmeans, condense"][..]),
        ("--storage 17", &["`--storage` = 17"]),
        ("--json no/such/folder/bench.json", &["no folder"]),
        ("--set data.width=20", &["`data.width` = 20: write a multiple of model.patch_size = 8"]),
    ] {
        place.clift(&format!("{BENCH} {flags}")).fails_with(2, expected);
    }
}

#[test]
fn features_of_a_file_have_their_own_number_of_tokens() {
    let place = Place::new();
    // The config's scenes have 8 tokens.
    let bytes: Vec<u8> = (0..40 * 4).flat_map(|i| ((i * 37 % 101) as f32).to_le_bytes()).collect();
    let view = safetensors::tensor::TensorView::new(safetensors::Dtype::F32, vec![40, 4], &bytes).expect("fits");
    let file = place.at("features.safetensors");
    safetensors::serialize_to_file([("features", view)], None, &file).expect("writable");
    let bench = |cases: &str, storage: usize| {
        let flags = format!("--case {cases} --repeats 1 --features DIR/features.safetensors --storage {storage}");
        place.clift(&format!("{BENCH} {flags}"))
    };
    bench("kmeans", 32).ok();
    bench("kmeans", 41).fails_with(2, &["`--storage` = 41", "a scene has 40 tokens"]);
    bench("kmeans,encode", 32).fails_with(2, &["a scene has 8 tokens; --case kmeans alone uses the tokens of"]);
}

#[test]
fn an_interrupted_benchmark_writes_nothing() {
    let place = Place::new();
    for (name, code) in [("-INT", 130), ("-TERM", 143)] {
        // Thousands of repetitions: the second row lasts until the signal arrives.
        let long = "--case encode,render --no-error --repeats 3000 --json DIR/bench.json";
        let mut child = place.start(&format!("{BENCH} {long}"));
        let mut lines = BufReader::new(child.stderr.take().expect("piped")).lines().map_while(Result::ok);
        assert!(lines.any(|line| line.starts_with("encode: ")), "the first row is done");
        signal(&child, name);
        let rest: Vec<String> = lines.collect();
        assert_eq!(finish(child).code, Some(code), "{rest:?}");
        let expected = "error: interrupted while timing `render`; no output files were written";
        assert!(rest.iter().any(|line| line == expected), "{rest:?}");
        assert!(!place.at("bench.json").exists());
    }
}
