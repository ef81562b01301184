//! Arguments of `clift doctor`.

use std::path::PathBuf;

/// Arguments of `clift doctor`.
#[derive(Debug, clap::Args)]
pub struct DoctorArgs {
    /// Run the stability cases instead: hard numerical inputs against f64
    #[arg(long)]
    pub stability: bool,
    /// Run small versions of the cases: seconds instead of minutes
    #[arg(long, requires = "stability")]
    pub small: bool,
    /// Write the table of the cases as Markdown
    #[arg(long, requires = "stability", value_name = "FILE")]
    pub markdown: Option<PathBuf>,
}
