//! Latent K-means (paper section 3.2): Lloyd iterations after a greedy k-means++ start.
//!
//! - `fit`: settings, result and iterations
//! - `seeding`: the initial centers
//! - `samples`: distances and means, on the device
//! - `labels`: assignments, on the host

pub(crate) mod fit;
pub(crate) mod labels;
pub(crate) mod samples;
pub(crate) mod seeding;
