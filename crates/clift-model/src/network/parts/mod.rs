//! The networks of a model, each one of several architectures' modules: `encoder`, `condenser`, `renderer`. `module_enum`
//! makes Burn modules of such enums.

pub(crate) mod condenser;
pub(crate) mod encoder;
pub(crate) mod module_enum;
pub(crate) mod renderer;
