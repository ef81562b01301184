//! The scenes of a run: the sources a config names.

use std::sync::Arc;

use clift_data::{
    Layout, LayoutOptions, Ledger, Opened, SceneSource, Split, SyntheticConfig, SyntheticSource, is_dl3dv_key,
};

use crate::TrainError;
use crate::config::DataConfig;
use crate::scene_subset::SceneSubset;

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

/// Does [`open`] for training: without the scenes that are too short for any step's views, which are in the ledger.
///
/// # Errors
/// As [`open`].
pub fn open_to_train(data: &DataConfig) -> Result<(Arc<dyn SceneSource>, Ledger), TrainError> {
    let (source, mut ledger) = open(data, Split::Train)?;
    let needed = data.views.min_frames();
    // A scene that cannot be read is met with its reason when it is drawn.
    let is_short = |scene: &usize| source.num_frames(*scene).is_ok_and(|num_frames| num_frames < needed);
    let (short, long): (Vec<usize>, Vec<usize>) = (0..source.num_scenes()).partition(is_short);
    if short.is_empty() {
        return Ok((source, ledger));
    }
    for scene in short {
        ledger.skip(source.key(scene), format!("shorter than the {needed} frames that data.views needs"));
    }
    if long.is_empty() {
        return Err(TrainError::NoScenes { reason: format!("{}: {ledger}", Split::Train) });
    }
    Ok((Arc::new(SceneSubset::new(source, long)), ledger))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::SourceKind;
    use clift_data::{BoundedSampler, SceneRecord, write_chunks};

    #[test]
    fn scenes_too_short_for_any_step_are_left_out_of_training_and_in_the_ledger() {
        let rooms =
            SyntheticSource::new(SyntheticConfig { num_frames: 8, num_scenes: 2, ..Default::default() }).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let record = |(scene, num_frames): (usize, usize)| {
            Ok(SceneRecord {
                key: format!("of-{num_frames}"),
                url: String::new(),
                timestamps: (0..num_frames as i64).collect(),
                cameras: rooms.cameras(scene)?[..num_frames].to_vec(),
                images: vec![vec![0]; num_frames],
            })
        };
        for split in [Split::Train, Split::Test] {
            let place = folder.path().join(split.to_string());
            write_chunks(&place, [(0, 4), (1, 5), (0, 8)].into_iter().map(record), 1).unwrap();
        }
        // Two contexts may lie 4 apart, three 8.
        let views =
            BoundedSampler { min_context: 2, max_context: 4, min_gap: [8, 9], max_gap: [8, 9], ..Default::default() };
        let mut data = DataConfig { views, source: SourceKind::Chunks, ..DataConfig::default() };
        data.root = Some(folder.path().to_owned());
        let (source, ledger) = open_to_train(&data).unwrap();
        assert_eq!((source.num_scenes(), source.key(0), source.find("of-8")), (2, "of-5", Some(1)));
        let expected = "2 of 3 scenes used; 1 shorter than the 5 frames that data.views needs";
        assert_eq!(ledger.to_string(), expected);
        assert_eq!(ledger.skips[0].key, "of-4");
        assert_eq!(open(&data, Split::Train).unwrap().0.num_scenes(), 3);
        data.views = BoundedSampler { min_gap: [9, 9], max_gap: [9, 9], ..Default::default() };
        let message = open_to_train(&data).err().unwrap().to_string();
        assert!(message.contains("train: 0 of 3 scenes used; 3 shorter than the 10 frames"), "{message}");
    }
}
