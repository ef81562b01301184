//! Operations on rows: layer norm, RMS norm and GELU, with their gradients.

pub(crate) mod gelu;
pub(crate) mod layer_norm;
pub(crate) mod rms_norm;
