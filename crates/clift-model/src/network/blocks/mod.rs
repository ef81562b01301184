//! Layers of the networks.
//!
//! - `norms`: QK norm and token norm
//! - `attention`: self- and cross-attention layers
//! - `feed_forward`: feed-forward layer
//! - `block`: pre-norm encoder and decoder blocks

pub(crate) mod attention;
pub(crate) mod block;
pub(crate) mod feed_forward;
pub(crate) mod norms;
