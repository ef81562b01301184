//! Hard cases against f64.
//!
//! - `case`: a hard case and its bound
//! - `attention`: long and extreme attention
//! - `updates`: updates on extreme views
//! - `clusters`: degenerate clusters
//! - `suite`: all cases, table

pub(crate) mod attention;
pub(crate) mod case;
pub(crate) mod clusters;
pub(crate) mod suite;
pub(crate) mod updates;
