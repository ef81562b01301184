//! `clift bench`: the rows it prints and the file it writes.

use std::io::{BufRead, BufReader};

use crate::support::{Place, finish, list, number, signal};

/// Times a network that takes milliseconds.
const BENCH: &str = "bench REPO/tests/micro.toml";

#[test]
fn rows_are_chosen_and_errors_omitted_on_request() {
    let place = Place::new();
    let report = |flags: &str| {
        let ran =
            place.clift(&format!("{BENCH} --case render,encode --repeats 2 --json DIR/bench.json --force {flags}"));
        for work in ["render", "encode"] {
            assert!(ran.stdout.lines().any(|line| line.starts_with(&format!("{work}  "))), "{work}: {}", ran.stdout);
            assert!(ran.stderr.lines().any(|line| line.starts_with(&format!("{work}: "))), "{work}: {}", ran.stderr);
        }
        ran.ok();
        place.json("bench.json")
    };
    let measured = report("");
    assert_eq!(measured["device"], "flex");
    assert!(measured["threads"].as_u64().is_some_and(|threads| threads > 0));
    let rows = list(&measured["rows"]);
    assert_eq!((&rows[0]["case"], &rows[1]["case"]), (&"encode".into(), &"render".into()));
    assert!(rows.iter().all(|row| number(row, "max_rel_error") > 0.0 && list(&row["samples_s"]).len() == 2));
    assert!(list(&report("--no-error")["rows"]).iter().all(|row| row["max_rel_error"].is_null()));
}

#[test]
fn what_cannot_be_timed_is_wrong_usage() {
    let place = Place::new();
    for (flags, expected) in [
        ("--case encode,incode", &["'incode'", "the cases are encode, kmeans, condense"][..]),
        ("--stored-tokens 17", &["`--stored-tokens` = 17"]),
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
        let flags = format!("--case {cases} --repeats 1 --features DIR/features.safetensors --stored-tokens {storage}");
        place.clift(&format!("{BENCH} {flags}"))
    };
    bench("kmeans", 32).ok();
    bench("kmeans", 41).fails_with(2, &["`--stored-tokens` = 41", "a scene has 40 tokens"]);
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
