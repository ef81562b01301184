//! Blockwise softmax attention.
//!
//! - `shapes`: sizes, strided rows, head blocks
//! - `forward`: blockwise attention, forward
//! - `backward`: blockwise attention, backward

pub(crate) mod backward;
pub(crate) mod forward;
pub(crate) mod shapes;
