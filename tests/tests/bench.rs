//! `clift bench`: the rows it prints and the file it writes.

use std::io::{BufRead, BufReader};

use serde_json::Value;

use crate::support::{Place, clift, finish, repository, signal, spawn};

/// Names of the rows, in order.
const ROWS: &str = "encode kmeans condense cluster_attention select render render_8_views stage1_step \
    stage1_step_tiny stage2_step";

/// Arguments for a network that takes milliseconds.
fn args(flags: &[&str]) -> Vec<String> {
    let config = repository("configs/tiny.toml").display().to_string();
    let model = "model={dim=16, num_heads=2, feed_forward_dim=24, num_encoder_blocks=1, num_renderer_blocks=1}";
    let set = [model, "data.width=16", "data.height=16", "stage1.batch_size=2", "stage2.batch_size=2"];
    let set = set.iter().flat_map(|text| ["--set".to_owned(), (*text).to_owned()]);
    ["bench".into(), config].into_iter().chain(set).chain(flags.iter().map(|&flag| flag.into())).collect()
}

#[test]
fn every_row_has_its_time_and_error() {
    let place = Place::new();
    let json = place.at("bench.json").display().to_string();
    let ran = clift(args(&["--repeats", "2", "--warmup", "0", "--json", &json])).ok();
    for work in ROWS.split(' ') {
        assert!(ran.stdout.lines().any(|line| line.starts_with(&format!("{work}  "))), "{work}: {}", ran.stdout);
        assert!(ran.stderr.lines().any(|line| line.starts_with(&format!("{work}: "))), "{work}: {}", ran.stderr);
    }
    let report = place.json("bench.json");
    assert_eq!(report["device"], "flex");
    assert!(report["threads"].as_u64().is_some_and(|threads| threads > 0));
    let rows = report["rows"].as_array().expect("rows");
    let names: Vec<&str> = rows.iter().map(|row| row["work"].as_str().expect("a name")).collect();
    assert_eq!(names.join(" "), ROWS);
    for row in rows {
        let number = |key: &str| row[key].as_f64().unwrap_or_else(|| panic!("{key} of {row}"));
        assert!(number("median_s") > 0.0 && number("p95_s") >= number("median_s"), "{row}");
        assert_eq!(row["samples_s"].as_array().map(Vec::len), Some(2), "{row}");
        // f32 through one or two blocks; f32 compared with itself would give exactly 0 everywhere.
        // Selection gives ids, which have no error.
        assert_eq!(row["max_rel_error"].is_null(), row["work"] == "select", "{row}");
        assert!(row["max_rel_error"].is_null() || number("max_rel_error") < 1e-4, "{row}");
        let peak = &row["peak_bytes"];
        assert!(peak.is_null() || peak.as_u64().is_some_and(|bytes| bytes > 1 << 20), "{row}");
        assert_eq!(row.get("inertia").is_some(), row["work"] == "kmeans", "{row}");
    }
    let exact = rows.iter().filter(|row| row["max_rel_error"] == 0.0 && row["work"] != "kmeans").count();
    assert_eq!(exact, 0, "{rows:?}");
}

#[test]
fn rows_are_chosen_and_errors_omitted_on_request() {
    let place = Place::new();
    let json = place.at("bench.json").display().to_string();
    let chosen = ["--case", "render,encode", "--no-error", "--repeats", "1", "--json", &json];
    clift(args(&chosen)).ok();
    let rows = &place.json("bench.json")["rows"];
    assert_eq!((&rows[0]["work"], &rows[1]["work"]), (&"encode".into(), &"render".into()));
    assert!(rows.as_array().is_some_and(|rows| rows.iter().all(|row| row["max_rel_error"] == Value::Null)));
}

#[test]
fn what_cannot_be_timed_is_wrong_usage() {
    clift(args(&["--case", "encode,incode"])).fails_with(2, &["'incode'", "the cases are encode, kmeans, condense"]);
    clift(args(&["--storage", "17"])).fails_with(2, &["`--storage` = 17"]);
    clift(args(&["--json", "no/such/folder/bench.json"])).fails_with(2, &["no folder"]);
    clift(args(&["--set", "data.width=20"]))
        .fails_with(2, &["`data.width` = 20: write a multiple of model.patch_size = 8"]);
}

#[test]
fn an_interrupted_benchmark_writes_nothing() {
    let place = Place::new();
    let json = place.at("bench.json").display().to_string();
    for (name, code) in [("-INT", 130), ("-TERM", 143)] {
        // Thousands of repetitions: the second row lasts until the signal arrives.
        let mut child = spawn(args(&["--case", "encode,render", "--no-error", "--repeats", "3000", "--json", &json]));
        let mut lines = BufReader::new(child.stderr.take().expect("piped")).lines().map_while(Result::ok);
        assert!(lines.any(|line| line.starts_with("encode: ")), "the first row is done");
        signal(&child, name);
        let rest: Vec<String> = lines.collect();
        assert_eq!(finish(child).code, Some(code), "{rest:?}");
        assert!(
            rest.iter().any(|line| line == "error: interrupted while timing `render`; no output files were written"),
            "{rest:?}"
        );
        assert!(!place.at("bench.json").exists());
    }
}
