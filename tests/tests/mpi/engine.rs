//! Starts ranks with `mpirun`.

use std::process::{Child, Command};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use crate::support::{BINARY, Place, start};

/// One run of several ranks at a time: ranks that wait keep their cores busy.
pub fn one_at_a_time() -> MutexGuard<'static, ()> {
    static ONE: Mutex<()> = Mutex::new(());
    ONE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Starts a training by `num_ranks` ranks of one thread, also as root, on any number of cores.
pub fn start_train(place: &Place, num_ranks: usize, words: &str, set: &[&str]) -> Child {
    let mut command = Command::new("mpirun");
    command.args(["-n", &num_ranks.to_string()]).env("RAYON_NUM_THREADS", "1").envs([
        ("OMPI_ALLOW_RUN_AS_ROOT", "1"),
        ("OMPI_ALLOW_RUN_AS_ROOT_CONFIRM", "1"),
        ("OMPI_MCA_rmaps_base_oversubscribe", "1"),
        ("OMPI_MCA_hwloc_base_binding_policy", "none"),
        // Ranks that wait let others compute.
        ("OMPI_MCA_mpi_yield_when_idle", "1"),
    ]);
    start(command.arg(BINARY).args(place.train_args(words, set)))
}

/// The process ids of the ranks of a running `mpirun`, given by its own, in no order.
pub fn ranks_of(mpirun: u32) -> Vec<u32> {
    let children = std::fs::read_to_string(format!("/proc/{mpirun}/task/{mpirun}/children")).unwrap_or_default();
    let is_rank =
        |id: &u32| std::fs::read_to_string(format!("/proc/{id}/cmdline")).is_ok_and(|words| words.starts_with(BINARY));
    children.split_whitespace().filter_map(|id| id.parse().ok()).filter(is_rank).collect()
}

pub fn signal(id: u32, name: &str) {
    // The rank may have ended meanwhile.
    drop(Command::new("kill").args([name, &id.to_string()]).output());
}

/// Ends an `mpirun` that is still there after a minute: where a rank dies while it starts, Open MPI can wait for ever.
pub fn end_within_a_minute(mpirun: &Child) {
    let id = mpirun.id();
    std::thread::spawn(move || {
        for _ in 0..60 {
            std::thread::sleep(Duration::from_secs(1));
            if !is_running(id) {
                return;
            }
        }
        eprintln!("mpirun {id} did not end within a minute of a killed rank: ended by the test");
        ranks_of(id).into_iter().chain([id]).for_each(|id| signal(id, "-KILL"));
    });
}

/// Whether a process is there, not counting one that has ended and that nobody has waited for.
pub fn is_running(id: u32) -> bool {
    let state = std::fs::read_to_string(format!("/proc/{id}/stat")).unwrap_or_default();
    state.rsplit(')').next().is_some_and(|rest| !rest.is_empty() && !rest.trim_start().starts_with('Z'))
}
