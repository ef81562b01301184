//! Latent K-means.
//!
//! - `fit`: Lloyd iterations
//! - `seeding`: greedy k-means++ start
//! - `samples`: distances and means on the device
//! - `labels`: assignment on the host

pub(crate) mod fit;
pub(crate) mod labels;
pub(crate) mod samples;
pub(crate) mod seeding;
