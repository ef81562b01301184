//! The scenes and views that are evaluated.

use clift_data::{ClipReader, EvaluationIndex, EvaluationItem, SkipReport, even_views};

use crate::config::eval_config::EvalConfig;
use crate::error::EvalError;

/// Chooses the scenes and views of an evaluation: those of its index, or views spread evenly.
///
/// At most `eval.num_scenes` (0: all) are taken, in the order of the index or the source. Scenes that cannot
/// be used are in the ledger.
///
/// # Errors
/// [`EvalError::Data`] for an index that cannot be read, and [`EvalError::NoScenes`] when no scene is left.
pub fn evaluation_items(
    eval: &EvalConfig,
    reader: &ClipReader,
) -> Result<(Vec<EvaluationItem>, SkipReport), EvalError> {
    let source = &reader.source;
    let (items, ledger) = if let Some(index) = &eval.index {
        EvaluationIndex::read(index)?.select(source.as_ref(), eval.num_scenes)
    } else {
        let limit = if eval.num_scenes == 0 { usize::MAX } else { eval.num_scenes };
        let count = source.num_scenes().min(limit);
        let mut ledger = SkipReport::new(count);
        let mut items = Vec::with_capacity(count);
        for scene in 0..count {
            match source.num_frames(scene).map(|count| even_views(count, eval.num_context, eval.num_targets)) {
                Ok(Some(views)) => items.push(EvaluationItem { scene, views }),
                Ok(None) => ledger.skip(source.key(scene), "too few frames for its views"),
                Err(error) => ledger.skip(source.key(scene), error.to_string()),
            }
        }
        (items, ledger)
    };
    if items.is_empty() {
        return Err(EvalError::NoScenes { reason: format!("evaluation: {ledger}") });
    }
    Ok((items, ledger))
}
