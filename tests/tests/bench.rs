//! `clift bench`: the rows it prints and the file it writes.

use crate::support::{Place, list, number};

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
