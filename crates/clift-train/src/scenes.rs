//! The scenes of a run: the sources a config names, and the clips that are evaluated.

use std::sync::Arc;

use clift_data::export::spread_views;
use clift_data::{
    Camera, ClipReader, DataError, EvaluationIndex, EvaluationItem, Frame, Layout, LayoutOptions, Ledger, Opened,
    SceneSource, Split, SyntheticConfig, SyntheticSource, is_dl3dv_key,
};
use clift_eval::EvalConfig;

use crate::TrainError;
use crate::config::DataConfig;

/// Opens one half of the data, with the ledger of what its filters left out.
///
/// # Errors
/// Whatever opening the source gives, and [`TrainError::NoScenes`] when the filters leave none.
pub fn open(data: &DataConfig, split: Split) -> Result<(Arc<dyn SceneSource>, Ledger), TrainError> {
    let (source, ledger) = match data.source.layout() {
        None => {
            let source = SyntheticSource::new(SyntheticConfig { split, ..data.synthetic.clone() })?;
            let ledger = Ledger::new(source.num_scenes());
            (Arc::new(source) as Arc<dyn SceneSource>, ledger)
        }
        Some(layout) => open_files(data, layout, split)?,
    };
    if source.num_scenes() == 0 {
        return Err(TrainError::NoScenes { reason: format!("{split}: {ledger}") });
    }
    Ok((source, ledger))
}

fn open_files(data: &DataConfig, layout: Layout, split: Split) -> Result<(Arc<dyn SceneSource>, Ledger), TrainError> {
    let missing =
        |key: &str, fix: &str| TrainError::BadConfig { key: key.into(), value: "missing".into(), fix: fix.into() };
    let root = data.root.as_deref();
    let root = root.ok_or_else(|| missing("data.root", "write the folder that holds train/ and test/"))?;
    let (filters, files) = (data.filters.clone(), data.files.clone());
    let options = LayoutOptions { layout, filters, files, min_size: [data.width, data.height], reads_chunks: false };
    let Opened { source, ledger, layout, has_splits } = Opened::open(root, split, &options)?;
    let has_dl3dv = match layout {
        Layout::Dl3dv => true,
        Layout::Captures => (0..source.num_scenes()).any(|scene| is_dl3dv_key(source.key(scene))),
        _ => false,
    };
    if split == Split::Train && has_dl3dv && !has_splits && data.files.test_scenes.is_none() {
        let fix = "the folders hold DL3DV's benchmark scenes too, which are not to be trained on: write the path of an \
                   evaluation index, or of a file with a key per line (an empty file for none)";
        return Err(missing("data.files.test_scenes", fix));
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

    fn encoded_frame(&self, scene: usize, frame: usize) -> Result<Option<Vec<u8>>, DataError> {
        self.source.encoded_frame(scene, frame)
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
