//! Attention and its gradients: `attention`, on `register_attention` or `matrix_attention` by the table of `tiles`;
//! `cluster_attention`, the attention inside clusters; `head_transform`, the transforms of heads by cameras.

#[allow(clippy::module_inception)] // the file of the operation
pub(crate) mod attention;
pub(crate) mod cluster_attention;
pub(crate) mod head_rows;
pub(crate) mod head_transform;
pub(crate) mod matrix_attention;
pub(crate) mod matrix_scores;
pub(crate) mod register_attention;
pub(crate) mod register_scores;
pub(crate) mod tiles;
