//! Opens the splits of a data set in any layout.

use std::path::{Path, PathBuf};

use clap::ValueEnum;
use clift_data::{DatasetRoot, FileOptions, OpenedSource, SourceOptions, Split, TestScenes, is_dl3dv_key, open_source};
use clift_train::parse_config;
use serde::{Deserialize, Serialize};

use crate::commands::args::parse::parse_input;
use crate::output::counter::scan_counter;

/// The config keys that `--set` accepts for a data set: `data.files.*`.
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

/// A data set on the command line.
#[derive(Debug, clap::Args)]
pub struct SourceArgs {
    /// Data set in any layout, or one scene
    #[arg(value_parser = parse_input)]
    pub dir: PathBuf,
    /// Set a path of the layout, e.g. `data.files.image_folder=images_4`; repeatable
    #[arg(long, value_name = "data.files.KEY=TOML")]
    pub set: Vec<String>,
}

impl SourceArgs {
    /// Returns the options of `--set`.
    pub fn files(&self) -> anyhow::Result<FileOptions> {
        let (keys, _) = parse_config::<Keys>(Path::new("--set"), "", &self.set, |_| Ok(()))?;
        Ok(keys.data.files)
    }

    pub fn open(&self, splits: Splits) -> anyhow::Result<Vec<SplitSource>> {
        open_splits(&self.dir, splits, &self.files()?)
    }
}

/// A split of a data set, or all scenes of one without splits.
pub struct SplitSource {
    /// The split; `None` for a data set without splits.
    pub split: Option<Split>,
    pub opened: OpenedSource,
}

impl SplitSource {
    /// Returns the display name: `train`, `test` or `scenes`.
    pub fn name(&self) -> String {
        self.split.map_or_else(|| "scenes".into(), |split| split.to_string())
    }
}

/// Returns the requested splits that exist; a single one for a data set without splits.
pub fn present_splits(root: &DatasetRoot, splits: Splits) -> Vec<Split> {
    let requested = splits.list();
    let is_present = |split: &Split| root.path.join(split.to_string()).is_dir();
    let present: Vec<Split> = requested.iter().copied().filter(is_present).collect();
    if present.is_empty() || !root.has_splits { requested[requested.len() - 1..].to_vec() } else { present }
}

/// Returns the options for reading every scene of a source, which includes the content of chunks.
pub fn read_all_options() -> SourceOptions {
    SourceOptions { reads_chunks: true, ..SourceOptions::default() }
}

/// Opens a folder without `train/` and `test/` once, unless a list of test scenes divides it.
pub fn open_splits(root: &Path, splits: Splits, files: &FileOptions) -> anyhow::Result<Vec<SplitSource>> {
    // An empty list divides nothing.
    let list = files.test_scenes.as_deref().map(TestScenes::read).transpose()?;
    let has_list = list.is_some_and(|list| list.num_scenes() > 0);
    let root = DatasetRoot::find(root)?;
    let is_listed = has_list && !root.has_splits;
    let present = if is_listed { splits.list().to_vec() } else { present_splits(&root, splits) };
    let mut sources = Vec::new();
    for split in present {
        let options = SourceOptions { files: files.clone(), ..read_all_options() };
        let mut opened = open_source(&root, split, &options, &mut scan_counter())?;
        let is_whole = opened.shares_scenes;
        if is_whole {
            let source = &opened.source;
            if files.test_scenes.is_none() && (0..source.num_scenes()).any(|scene| is_dl3dv_key(source.key(scene))) {
                let note = "folders of DL3DV include its benchmark scenes; reserve these for testing with \
                            --set data.files.test_scenes=LIST";
                opened.report.notes.push(note.into());
            }
        }
        sources.push(SplitSource { split: (!is_whole).then_some(split), opened });
    }
    Ok(sources)
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Splits {
    /// Training scenes
    Train,
    /// Test scenes
    Test,
    /// Both splits
    Both,
}

impl Splits {
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
    use super::*;

    #[test]
    fn set_accepts_only_keys_of_data_files() {
        for set in ["data.width=64", "data.files.undistrot=true", "stage1.steps=2"] {
            let error = SourceArgs { dir: "data".into(), set: vec![set.into()] }.files().unwrap_err();
            assert!(error.is::<clift_train::ConfigError>(), "{set}: {error}");
        }
    }

    #[test]
    fn list_of_test_scenes_divides_a_folder_without_splits() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../data-fixtures/re10k-mini/train");
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("list");
        let opened = |keys: &str, splits: Splits| {
            std::fs::write(&path, keys).unwrap();
            let files = FileOptions { test_scenes: Some(path.clone()), ..FileOptions::default() };
            let sources = open_splits(&root, splits, &files).unwrap();
            let counts = sources.iter().map(|source| (source.name(), source.opened.source.num_scenes()));
            counts.collect::<Vec<_>>()
        };
        let all = opened("", Splits::Both);
        assert_eq!((all.len(), &all[0].0[..]), (1, "scenes"));
        let root = DatasetRoot::find(&root).unwrap();
        let test = open_source(&root, Split::Test, &SourceOptions::default(), &mut |_, _| ()).unwrap();
        let key = test.source.key(0);
        let (train, test) = (("train".to_owned(), all[0].1 - 1), ("test".to_owned(), 1));
        assert_eq!(opened(key, Splits::Both), [train, test.clone()]);
        assert_eq!(opened(key, Splits::Test), [test]);
    }
}
