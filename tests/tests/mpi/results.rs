//! Several ranks end where one process ends.

use crate::engine::{mpirun, one_at_a_time, start_train};
use crate::support::{BINARY, Place, finish, start};

#[test]
fn a_finished_run_is_reported_by_rank_0_alone() {
    let _one = one_at_a_time();
    let place = Place::new();
    place.train("run", &[]).ok();
    let ran = finish(start_train(&place, 2, "run", &[])).ok();
    assert_eq!(ran.stderr.matches("the run is trained and evaluated").count(), 1, "{}", ran.stderr);
    assert_eq!(ran.stdout.matches("report: ").count(), 1, "{}", ran.stdout);
}

#[test]
fn sums_are_timed_and_checked() {
    let _one = one_at_a_time();
    let place = Place::new();
    let json = place.at("sum.json").display().to_string();
    let words = ["bench", "allreduce", "--values", "1,1000,1000003", "--repeats", "2", "--json", &json];
    finish(start(mpirun(3).arg(BINARY).args(words))).ok().prints("3 ranks, a message to all: ");
    let report = place.json("sum.json");
    assert_eq!(report["num_ranks"], 3);
    assert_eq!(report["rows"][2]["sent_bytes"], 2 * 2 * 4 * 1_000_003 / 3);
}
