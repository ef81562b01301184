//! Arguments of `clift doctor`.

use std::path::PathBuf;

/// Arguments of `clift doctor`.
#[derive(Debug, clap::Args)]
pub struct DoctorArgs {
    /// Run the hard cases instead
    #[arg(long)]
    pub stability: bool,
    /// At the sizes of the tests: seconds instead of minutes
    #[arg(long, requires = "stability")]
    pub small: bool,
    /// Write their table as Markdown
    #[arg(long, requires = "stability", value_name = "FILE")]
    pub markdown: Option<PathBuf>,
}
