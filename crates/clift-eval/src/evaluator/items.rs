//! The evaluated scenes and views.

use clift_data::{ClipReader, EvaluationIndex, EvaluationItem, SkipReport};

use crate::config::eval_config::EvalConfig;
use crate::config::split::{EvalFrames, EvalSplit};
use crate::error::EvalError;

/// Chooses the scenes and views of an evaluation, and returns what they measure: from the index, or evenly spread views of
/// `frames`.
///
/// Takes at most `eval.num_scenes` scenes (0: all), in the order of the index or the source. Unusable scenes are in the skip
/// report.
pub fn evaluation_items(
    eval: &EvalConfig,
    reader: &ClipReader,
    frames: EvalFrames,
) -> Result<(Vec<EvaluationItem>, SkipReport, EvalSplit), EvalError> {
    let source = &reader.source;
    let (items, skip_report) = if let Some(index) = &eval.index {
        let index = EvaluationIndex::read(index)?;
        let index = if eval.drop_context_targets { index.without_context_targets() } else { index };
        index.select(source.as_ref(), eval.num_scenes)
    } else {
        let limit = if eval.num_scenes == 0 { usize::MAX } else { eval.num_scenes };
        let count = source.num_scenes().min(limit);
        let mut skip_report = SkipReport::new(count);
        let mut items = Vec::with_capacity(count);
        for scene in 0..count {
            match frames.views(source.as_ref(), scene, eval.num_context, eval.num_targets) {
                Ok(Some(views)) => items.push(EvaluationItem { scene, views }),
                Ok(None) => {
                    skip_report.skip(source.key(scene), "too few frames for eval.num_context and eval.num_targets");
                }
                Err(error) => skip_report.skip(source.key(scene), error.to_string()),
            }
        }
        (items, skip_report)
    };
    if items.is_empty() {
        return Err(EvalError::NoScenes { reason: format!("evaluation: {skip_report}") });
    }
    let split = frames.of_views(source.as_ref(), &items);
    Ok((items, skip_report, split))
}
