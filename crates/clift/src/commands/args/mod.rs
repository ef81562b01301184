//! Arguments that several commands share: `parse` (values), `shared_args` (options), `splits` (data sets), `model_args` (a
//! model with its data).

pub(crate) mod model_args;
pub(crate) mod parse;
pub(crate) mod shared_args;
pub(crate) mod splits;
