//! Counts, groups and subsets of tokens.
//!
//! - `count`: token count: number or share
//! - `kind`: condensed or K-means tokens
//! - `clusters`: cluster of every token, checked
//! - `tiles`: rectangular tiles, the baseline grouping
//! - `kmeans`: latent K-means
//! - `selection`: Algorithm 1: tokens for a view

pub(crate) mod clusters;
pub(crate) mod count;
pub(crate) mod kind;
pub(crate) mod kmeans;
pub(crate) mod selection;
pub(crate) mod tiles;
