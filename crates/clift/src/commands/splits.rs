//! The halves of a data folder, whatever its layout.

use std::path::Path;

use clap::ValueEnum;
use clift_data::{
    DatasetRoot, FileOptions, OpenedSource, SAME_SCENES, SourceOptions, Split, TestScenes, is_dl3dv_key, open_source,
};
use clift_train::{Override, parse_config};
use serde::{Deserialize, Serialize};

use crate::output::stdout::print_note;

/// The keys of a config that say where the parts of a layout are: those that `--set` takes here.
#[derive(Debug, Default, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
struct Keys {
    data: DataKeys,
}

#[derive(Debug, Default, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
struct DataKeys {
    files: FileOptions,
}

/// Reads `--set data.files.KEY=VALUE`; also gives back what was set.
///
/// # Errors
/// [`clift_train::ConfigError`] for any other key and for values of another type.
pub fn files(set: &[String]) -> anyhow::Result<(FileOptions, Vec<Override>)> {
    let (keys, changes) = parse_config::<Keys>(Path::new("--set"), "", set)?;
    Ok((keys.data.files, changes))
}

/// A half of a folder, or all of one that is not divided.
pub struct SplitSource {
    /// Which half; `None` for all of a folder that is not divided.
    pub split: Option<Split>,
    /// Its scenes.
    pub opened: OpenedSource,
}

impl SplitSource {
    /// What to call it.
    pub fn name(&self) -> String {
        self.split.map_or_else(|| "scenes".into(), |split| split.to_string())
    }

    /// Tells what opening it left out, and what else is to be known.
    pub fn print_news(&self) {
        if self.opened.report.has_content() {
            print_note(&format!("{}: {}", self.name(), self.opened.report));
        }
    }
}

/// The halves asked for that are there; one, whichever, for a folder that is not divided.
pub fn halves_there(root: &DatasetRoot, splits: Splits) -> Vec<Split> {
    let is_there = |split: &Split| root.path().join(split.to_string()).is_dir();
    let there: Vec<Split> = splits.list().iter().copied().filter(is_there).collect();
    if there.is_empty() || !root.has_splits() { splits.list()[splits.list().len() - 1..].to_vec() } else { there }
}

/// How all of a folder is opened: everything is going to be read, so that chunks are looked into.
pub fn options() -> SourceOptions {
    SourceOptions { reads_chunks: true, ..SourceOptions::default() }
}

/// Opens the halves asked for that are there. A folder without `train/` and `test/` counts once, unless a list of test
/// scenes divides it.
///
/// # Errors
/// The first error of opening one.
pub fn splits(root: &Path, splits: Splits, files: &FileOptions) -> anyhow::Result<Vec<SplitSource>> {
    // An empty list keeps no scene for testing and divides nothing.
    let list = files.test_scenes.as_deref().map(TestScenes::read).transpose()?;
    let has_list = list.is_some_and(|list| list.num_scenes() > 0);
    let root = DatasetRoot::find(root)?;
    let is_listed = has_list && !root.has_splits();
    let wanted = if is_listed { splits.list().to_vec() } else { halves_there(&root, splits) };
    let mut halves = Vec::new();
    for split in wanted {
        let mut opened = open_source(&root, split, &SourceOptions { files: files.clone(), ..options() })?;
        let is_whole = !opened.has_splits && !has_list;
        if is_whole {
            // Here they are no halves.
            opened.report.notes.retain(|note| note != SAME_SCENES);
            let source = &opened.source;
            if files.test_scenes.is_none() && (0..source.num_scenes()).any(|scene| is_dl3dv_key(source.key(scene))) {
                let note = "DL3DV's folders hold the scenes of its benchmark too; --set data.files.test_scenes=LIST \
                            keeps those apart";
                opened.report.notes.push(note.into());
            }
        }
        halves.push(SplitSource { split: (!is_whole).then_some(split), opened });
    }
    Ok(halves)
}

/// One split, or both.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Splits {
    /// Scenes to train on
    Train,
    /// Scenes held back
    Test,
    /// Both
    Both,
}

impl Splits {
    /// The splits meant.
    pub fn list(self) -> &'static [Split] {
        match self {
            Self::Train => &[Split::Train],
            Self::Test => &[Split::Test],
            Self::Both => &[Split::Train, Split::Test],
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;

    #[test]
    fn set_takes_the_keys_of_the_files_and_no_others() {
        let (read, changes) = files(&["data.files.image_folder=images_4".into()]).unwrap();
        assert_eq!(read.image_folder.as_deref(), Some("images_4"));
        assert_eq!(changes[0].to_string(), "--set data.files.image_folder: (default) -> \"images_4\"");
        assert!(files(&[]).unwrap().1.is_empty());
        for wrong in ["data.width=64", "data.files.undistrot=true", "stage1.steps=2"] {
            assert!(files(&[wrong.into()]).unwrap_err().is::<clift_train::ConfigError>(), "{wrong}");
        }
    }

    #[test]
    fn a_list_divides_a_folder_without_halves() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../data-fixtures/re10k-mini/train");
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("list");
        let opened = |keys: Option<&str>, which: Splits| {
            let test_scenes = keys.map(|keys| {
                std::fs::write(&path, keys).unwrap();
                PathBuf::from(&path)
            });
            let halves = splits(&root, which, &FileOptions { test_scenes, ..FileOptions::default() }).unwrap();
            let told = halves.iter().map(|half| (half.name(), half.opened.source.num_scenes()));
            told.collect::<Vec<_>>()
        };
        let all = opened(None, Splits::Both);
        assert_eq!((all.len(), &all[0].0[..]), (1, "scenes"));
        assert_eq!(opened(Some(""), Splits::Both), all);
        let half = open_source(&DatasetRoot::find(&root).unwrap(), Split::Test, &SourceOptions::default()).unwrap();
        let key = half.source.key(0);
        let (train, test) = (("train".to_owned(), all[0].1 - 1), ("test".to_owned(), 1));
        assert_eq!(opened(Some(key), Splits::Both), [train.clone(), test.clone()]);
        assert_eq!(opened(Some(key), Splits::Train), [train]);
        assert_eq!(opened(Some(key), Splits::Test), [test]);
    }
}
