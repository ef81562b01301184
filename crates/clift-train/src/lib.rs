//! The two-stage trainer: stage 1, cluster cache, stage 2, checkpoints and resume
