//! One file per command.
//!
//! - `parse`: shared argument parsers
//! - `train`: `clift train`
//! - `eval`: `clift eval`
//! - `compare`: `clift compare`
//! - `flops`: `clift flops`
//! - `encode`: `clift encode`
//! - `plan`: `clift plan`
//! - `import`: `clift import`
//! - `export`: `clift export`
//! - `splits`: open the splits of a folder
//! - `render`: `clift render`
//! - `data`: `clift data`
//! - `bench`: `clift bench`
//! - `doctor`: `clift doctor`

pub(crate) mod bench;
pub(crate) mod compare;
pub(crate) mod data;
pub(crate) mod doctor;
pub(crate) mod encode;
pub(crate) mod eval;
pub(crate) mod export;
pub(crate) mod flops;
pub(crate) mod import;
pub(crate) mod parse;
pub(crate) mod plan;
pub(crate) mod render;
pub(crate) mod splits;
pub(crate) mod train;
