//! Layers of the networks: `norms` of tokens, queries and keys; `attention` and `feed_forward` layers; and in `block` the
//! pre-norm encoder and decoder blocks that are made of them.
//! Tokens `x` and results are `[batch, count, dim]` unless a function says otherwise.

pub(crate) mod attention;
pub(crate) mod block;
pub(crate) mod feed_forward;
pub(crate) mod norms;
