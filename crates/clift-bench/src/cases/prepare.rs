//! Inputs of a case, ready to be timed.

use clift_train::{Stage, TrainError};

use crate::cases::case::BenchCase;
use crate::cases::clustering::KMeansCase;
use crate::cases::context::BenchContext;
use crate::cases::forward::{ClusterAttentionCase, CondenseCase, EncodeCase, RenderCase};
use crate::cases::selection::SelectionCase;
use crate::cases::step::StepCase;
use crate::cases::task::BenchTask;

/// Makes networks and inputs of a case, so that only its computation is left to be timed.
///
/// # Errors
/// [`TrainError::BadConfig`] for impossible sizes, and those of the device or a file of features.
pub(crate) fn prepare(case: BenchCase, context: &BenchContext) -> Result<Box<dyn BenchTask>, TrainError> {
    Ok(match case {
        BenchCase::Encode => Box::new(EncodeCase::new(context)?),
        BenchCase::Kmeans => Box::new(KMeansCase::new(context)?),
        BenchCase::Condense => Box::new(CondenseCase::new(context)?),
        BenchCase::ClusterAttention => Box::new(ClusterAttentionCase::new(context)?),
        BenchCase::Select => Box::new(SelectionCase::new(context)?),
        BenchCase::Render => Box::new(RenderCase::new(context, 1)?),
        BenchCase::Render8Views => Box::new(RenderCase::new(context, 8)?),
        BenchCase::Stage1Step => Box::new(StepCase::new(context, Stage::Stage1)?),
        BenchCase::Stage1StepTiny => Box::new(StepCase::new(&context.tiny(), Stage::Stage1)?),
        BenchCase::Stage2Step => Box::new(StepCase::new(context, Stage::Stage2)?),
    })
}
