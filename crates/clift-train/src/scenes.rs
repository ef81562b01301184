//! The scenes of a run: the sources a config names, and the clips that are evaluated.

use std::sync::Arc;

use clift_data::export::spread_views;
use clift_data::{
    Camera, ChunkSource, ClipReader, DataError, EvaluationIndex, EvaluationItem, Frame, Ledger, SceneSource, Split,
    SyntheticConfig, SyntheticSource,
};
use clift_eval::EvalConfig;

use crate::TrainError;
use crate::config::{DataConfig, SourceKind};

/// Opens one half of the data, with the ledger of what its filters left out.
///
/// # Errors
/// Whatever opening the source gives, and [`TrainError::NoScenes`] when the filters leave none.
pub fn open(data: &DataConfig, split: Split) -> Result<(Arc<dyn SceneSource>, Ledger), TrainError> {
    let (source, ledger): (Arc<dyn SceneSource>, Ledger) = match data.source {
        SourceKind::Synthetic => {
            let source = SyntheticSource::new(SyntheticConfig { split, ..data.synthetic.clone() })?;
            let ledger = Ledger::new(source.num_scenes());
            (Arc::new(source), ledger)
        }
        SourceKind::Chunks => {
            let root = data.root.as_deref().ok_or_else(|| TrainError::BadConfig {
                key: "data.root".into(),
                value: "missing".into(),
                fix: "write the folder that holds train/ and test/".into(),
            })?;
            let source = ChunkSource::open(root, split, &data.filters)?;
            let ledger = source.ledger().clone();
            (Arc::new(source), ledger)
        }
    };
    if source.num_scenes() == 0 {
        return Err(TrainError::NoScenes { reason: format!("{split}: {ledger}") });
    }
    Ok((source, ledger))
}

/// The first scenes of a source, for `--overfit`.
pub struct FirstScenes {
    source: Arc<dyn SceneSource>,
    num_scenes: usize,
}

impl FirstScenes {
    /// Keeps at most `num_scenes`.
    pub fn of(source: Arc<dyn SceneSource>, num_scenes: usize) -> Self {
        Self { num_scenes: num_scenes.min(source.num_scenes()), source }
    }
}

impl SceneSource for FirstScenes {
    fn num_scenes(&self) -> usize {
        self.num_scenes
    }

    fn key(&self, scene: usize) -> &str {
        self.source.key(scene)
    }

    fn find(&self, key: &str) -> Option<usize> {
        self.source.find(key).filter(|scene| *scene < self.num_scenes)
    }

    fn num_frames(&self, scene: usize) -> Result<usize, DataError> {
        self.source.num_frames(scene)
    }

    fn cameras(&self, scene: usize) -> Result<Vec<Camera>, DataError> {
        self.source.cameras(scene)
    }

    fn frame(&self, scene: usize, frame: usize) -> Result<Frame, DataError> {
        self.source.frame(scene, frame)
    }
}

/// Chooses the scenes and views of an evaluation: those of its index, or views spread evenly.
///
/// At most `num_scenes` (0: all) are taken, in the order of the index or the source. Scenes that cannot
/// be used are in the ledger.
///
/// # Errors
/// Whatever reading the index gives, and [`TrainError::NoScenes`] when none is left.
pub fn evaluation_items(
    eval: &EvalConfig,
    reader: &ClipReader,
    num_scenes: usize,
) -> Result<(Vec<EvaluationItem>, Ledger), TrainError> {
    let source = &reader.source;
    let (items, ledger) = if let Some(index) = &eval.index {
        EvaluationIndex::read(index)?.select(source.as_ref(), num_scenes)
    } else {
        let limit = if num_scenes == 0 { usize::MAX } else { num_scenes };
        let count = source.num_scenes().min(limit);
        let mut ledger = Ledger::new(count);
        let mut items = Vec::with_capacity(count);
        for scene in 0..count {
            match source.num_frames(scene).map(|count| spread_views(count, eval.num_context, eval.num_targets)) {
                Ok(Some(views)) => items.push(EvaluationItem { scene, views }),
                Ok(None) => ledger.skip(source.key(scene), "too few frames for its views"),
                Err(error) => ledger.skip(source.key(scene), error.to_string()),
            }
        }
        (items, ledger)
    };
    if items.is_empty() {
        return Err(TrainError::NoScenes { reason: format!("evaluation: {ledger}") });
    }
    Ok((items, ledger))
}
