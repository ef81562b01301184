//! One file or folder per command: arguments, the call, the printed result.
//!
//! - `parse`: parsers of argument values
//! - `shared_args`: arguments that several commands share
//! - `splits`: open the splits of a data set
//! - `train`: `clift train`
//! - `eval`: `clift eval`
//! - `compare`: `clift compare`
//! - `flops`: `clift flops`
//! - `encode`: `clift encode`
//! - `render`: `clift render`
//! - `data`: `clift data`
//! - `plan`: `clift plan`
//! - `doctor`: `clift doctor`
//! - `bench`: `clift bench`
//! - `import`: `clift import`
//! - `export`: `clift export`

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
pub(crate) mod shared_args;
pub(crate) mod splits;
pub(crate) mod train;
