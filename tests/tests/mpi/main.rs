//! Runs of several ranks on MPI.
