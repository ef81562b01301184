//! The groups of the training set's tokens, made before stage 2.
//!
//! - `resume_log`: finished sets of a build
//! - `cache`: entries and index; read the finished cache
//! - `builder`: cluster every training scene

pub(crate) mod builder;
pub(crate) mod cache;
pub(crate) mod resume_log;
