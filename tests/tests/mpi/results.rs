//! Several ranks end where one process ends.

use crate::engine::{one_at_a_time, start_train};
use crate::support::{Place, finish};

#[test]
fn a_finished_run_is_reported_by_rank_0_alone() {
    let _one = one_at_a_time();
    let place = Place::new();
    place.train("run", &[]).ok();
    let ran = finish(start_train(&place, 2, "run", &[])).ok();
    assert_eq!(ran.stderr.matches("the run is trained and evaluated").count(), 1, "{}", ran.stderr);
    assert_eq!(ran.stdout.matches("report: ").count(), 1, "{}", ran.stdout);
}
