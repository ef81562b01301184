//! Counts, groups and subsets of tokens.
//!
//! - `count`: a number or share of tokens
//! - `kind`: condensed tokens, K-means tokens or all tokens
//! - `clusters`: the cluster of every token, on the host and on a device
//! - `grouping`: the choice of the groups
//! - `kmeans`: latent K-means, the grouping of the paper
//! - `tiles`: rectangular tiles, the baseline grouping
//! - `selection`: the tokens for a target view (Algorithm 1)

pub(crate) mod clusters;
pub(crate) mod count;
pub(crate) mod grouping;
pub(crate) mod kind;
pub(crate) mod kmeans;
pub(crate) mod selection;
pub(crate) mod tiles;
