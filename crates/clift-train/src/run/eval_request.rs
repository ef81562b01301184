//! What an evaluation measures, and where its results are written.

use clift_data::Split;
use clift_eval::ExternalMethod;

use crate::run::eval_folder::EvalFolder;

/// What an evaluation measures, and where its results are written.
#[derive(Clone, Copy, Debug)]
pub struct EvalRequest<'a> {
    /// The split of the data set.
    pub split: Split,
    /// Methods of other programs, measured beside the model.
    pub external: &'a [ExternalMethod],
    /// Folder of the results.
    pub folder: &'a EvalFolder,
}
