//! Runs of several ranks on MPI, on one machine: `cargo test --release --workspace --features mpi --test mpi_suite`.
//!
//! Needs `mpirun` of the MPI that the build found. `clift-train` tests the same rules without MPI, on threads.

mod ends;
mod engine;
mod kills;
#[allow(dead_code)]
#[path = "../support.rs"]
mod support;
