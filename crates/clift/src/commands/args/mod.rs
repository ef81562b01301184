//! Arguments that several commands share: `parse` (values), `shared_args` (options), `splits` (data sets).

pub(crate) mod parse;
pub(crate) mod shared_args;
pub(crate) mod splits;
