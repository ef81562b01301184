//! The ranks that a launcher started: `mpirun`, or `srun` of SLURM.

use crate::distributed::ranks::Ranks;
use crate::error::TrainError;

/// Environment variables with the number of ranks and the own rank: Open MPI; MPICH and Intel MPI; a job step of SLURM.
/// `mpirun` starts its ranks inside such a step.
const VARIABLES: [[&str; 2]; 3] = [
    ["OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_RANK"],
    ["PMI_SIZE", "PMI_RANK"],
    ["SLURM_STEP_NUM_TASKS", "SLURM_PROCID"],
];

/// A process among those of a launcher, as its environment describes it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Launched {
    /// The number of this process, from 0.
    pub rank: usize,
    /// The number of processes.
    pub num_ranks: usize,
}

impl Launched {
    /// Reads the environment of this process; without a launcher it is the only one.
    pub fn find() -> Self {
        Self::of(|name| std::env::var(name).ok())
    }

    fn of(variable: impl Fn(&str) -> Option<String>) -> Self {
        let number = |name: &str| variable(name)?.trim().parse().ok();
        let found = VARIABLES.iter().find_map(|[size, rank]| Some((number(size)?, number(rank)?)));
        found.map_or(Self { rank: 0, num_ranks: 1 }, |(num_ranks, rank)| Self { rank, num_ranks })
    }

    /// Connects the processes of the launcher.
    pub fn connect(self) -> Result<Ranks, TrainError> {
        if self.num_ranks > 1 { connect(self.num_ranks) } else { Ok(Ranks::single()) }
    }
}

#[cfg(feature = "mpi")]
fn connect(num_ranks: usize) -> Result<Ranks, TrainError> {
    use crate::distributed::mpi::MpiRank;
    use crate::distributed::ranks::Communicator;
    let found = MpiRank::start();
    let num_found = found.as_ref().map_or(0, Communicator::num_ranks);
    match found {
        Some(rank) if num_found == num_ranks => Ok(Ranks::new(rank)),
        _ => {
            let reason = format!(
                "MPI connects {num_found} of them: use the mpirun of the MPI that clift was built with, or `srun --mpi=pmix`"
            );
            Err(TrainError::NoMpi { num_ranks, reason })
        }
    }
}

#[cfg(not(feature = "mpi"))]
fn connect(num_ranks: usize) -> Result<Ranks, TrainError> {
    let reason =
        "this build has no MPI: rebuild with `cargo build --release --features mpi` (on Debian after `apt-get \
                  install openmpi-bin libopenmpi-dev libclang-dev`), or start one process"
            .into();
    Err(TrainError::NoMpi { num_ranks, reason })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn launchers_are_recognised_by_their_variables() {
        let launched = |variables: &[(&str, &str)]| {
            let found = Launched::of(|name| {
                variables.iter().find(|(other, _)| *other == name).map(|(_, value)| (*value).to_owned())
            });
            [found.rank, found.num_ranks]
        };
        assert_eq!(launched(&[]), [0, 1]);
        assert_eq!(launched(&[("PMI_RANK", "3"), ("PMI_SIZE", "4")]), [3, 4]);
        let step = [("SLURM_STEP_NUM_TASKS", "2"), ("SLURM_PROCID", "1")];
        let mpirun = [("OMPI_COMM_WORLD_SIZE", "8"), ("OMPI_COMM_WORLD_RANK", "5")];
        assert_eq!((launched(&step), launched(&[step, mpirun].concat())), ([1, 2], [5, 8]), "mpirun inside a job step");
        assert_eq!(launched(&[("SLURM_PROCID", "0"), ("SLURM_NTASKS", "4")]), [0, 1], "a batch script is no job step");
    }
}
