//! The ranks of a run: processes that train together, one device each.
//!
//! - `ranks`: exchange of data between ranks, and failures that all ranks learn of
//! - `parts`: the parts of a batch, and those of a rank
//! - `machine`: host, cores and device of a rank
//! - `launch`: the ranks that a launcher started
//! - `mpi`: ranks on MPI (cargo feature `mpi`)

pub(crate) mod launch;
pub(crate) mod machine;
#[cfg(feature = "mpi")]
pub(crate) mod mpi;
pub(crate) mod parts;
pub(crate) mod ranks;
#[cfg(test)]
pub(crate) mod testing;
