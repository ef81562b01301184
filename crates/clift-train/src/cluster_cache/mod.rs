//! Offline K-means of the training set.
//!
//! - `entry`: one clustered context set
//! - `resume_log`: finished sets of a build
//! - `cache`: read the finished cache
//! - `builder`: cluster every training scene

pub(crate) mod builder;
pub(crate) mod cache;
pub(crate) mod entry;
pub(crate) mod resume_log;
