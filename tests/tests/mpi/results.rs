//! Several ranks end where one process ends.

use crate::engine::{mpirun, one_at_a_time, start_train};
use crate::support::{BINARY, Place, finish, start};

const BATCH: [&str; 2] = ["stage1.batch_size=4", "stage2.batch_size=4"];

#[test]
fn ranks_end_bit_for_bit_where_one_process_with_as_many_parts_ends() {
    let _one = one_at_a_time();
    let place = Place::new();
    for num_ranks in [2, 3] {
        let parts = [1, 2].map(|stage| format!("stage{stage}.accumulate={num_ranks}"));
        let set: Vec<&str> = BATCH.iter().copied().chain(parts.iter().map(String::as_str)).collect();
        let [one, several] = ["one", "several"].map(|name| format!("{name}-{num_ranks}"));
        place.train(&one, &set).ok();
        let ran = finish(start_train(&place, num_ranks, &several, &set)).ok();
        let expected = format!("{num_ranks} ranks share batches of 4 scenes in {num_ranks} parts");
        assert_eq!(ran.stderr.matches(&expected).count(), 2, "once in each stage, by rank 0: {}", ran.stderr);
        assert!(ran.stderr.contains("rank 1: flex with 1 thread"), "{}", ran.stderr);
        place.assert_same_run(&several, &one);
    }
}

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
