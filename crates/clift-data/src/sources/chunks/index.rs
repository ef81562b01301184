//! The file of every scene in a folder of chunks: read from `index.json`, or determined from the files.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::path::{Component, Path};

use rayon::prelude::*;

use crate::error::DataError;
use crate::files::bounded::{parse_json, read_bounded};
use crate::files::listing::{file_names, has_ending};
use crate::skip_report::{SkipReport, first_few, note_on, plural};
use crate::sources::chunks::table::ChunkTable;
use crate::sources::test_scenes::TestScenes;

/// List of the authors' released code, beside one file per scene: keys of scenes whose images have another size.
const INVALID_KEYS: &str = "invalid_keys.txt";

/// Largest size of an `index.json`; the one of `RealEstate10K` has 3 MB.
const MAX_INDEX_BYTES: u64 = 1 << 30;

/// Reads `index.json`: file names by scene key.
pub(crate) fn read_index(path: &Path) -> Result<BTreeMap<String, String>, DataError> {
    let bad = |what: String| DataError::BadIndex { what, path: path.to_path_buf() };
    let text = read_bounded(path, MAX_INDEX_BYTES, "reading the scene index")?;
    let index: BTreeMap<String, String> = parse_json(&text)
        .map_err(|error| bad(format!("expected a map from scene keys to chunk files, got {error}")))?;
    for (key, file) in &index {
        if file.is_empty() || !Path::new(file).components().all(|part| matches!(part, Component::Normal(_))) {
            return Err(bad(format!("scene {key} is in {file:?}, expected a file beside the index")));
        }
    }
    Ok(index)
}

/// Returns a note on chunks in `folder` that `index` does not list.
pub(crate) fn note_unlisted(folder: &Path, index: &BTreeMap<String, String>) -> Result<Option<String>, DataError> {
    let mut files = torch_files(folder)?;
    let mut named: Vec<&String> = index.values().collect();
    named.sort_unstable();
    files.retain(|file| named.binary_search(&file).is_err());
    let note = || {
        let counted = plural(files.len(), ".torch file");
        format!("not opened, missing from index.json: {counted} ({})", first_few(&files))
    };
    Ok((!files.is_empty()).then(note))
}

/// Returns the file of every scene without an index: by file name for one file per scene, by table for chunks.
pub(crate) fn index_of_files(folder: &Path, report: &mut SkipReport) -> Result<BTreeMap<String, String>, DataError> {
    let files = torch_files(folder)?;
    let stem = |file: &str| file.strip_suffix(".torch").unwrap_or(file).to_owned();
    let first = files.iter().take(8).find_map(|file| Some((file, ChunkTable::read(&folder.join(file)).ok()?)));
    if first.is_some_and(|(file, table)| table.scenes.len() != 1 || !table.scenes.contains_key(&stem(file))) {
        return Ok(index_of_chunks(folder, &files, report));
    }
    let mut index: BTreeMap<String, String> = files.iter().map(|file| (stem(file), file.clone())).collect();
    let invalid = folder.join(INVALID_KEYS);
    if invalid.is_file() {
        let invalid = TestScenes::read(&invalid)?;
        for key in index.keys().filter(|key| invalid.contains(key)) {
            report.num_scenes += 1;
            report.skip(key, format!("in {INVALID_KEYS}"));
        }
        index.retain(|key, _| !invalid.contains(key));
    }
    Ok(index)
}

fn index_of_chunks(folder: &Path, files: &[String], report: &mut SkipReport) -> BTreeMap<String, String> {
    let tables: Vec<_> = files.par_iter().map(|file| (file, ChunkTable::read(&folder.join(file)))).collect();
    let mut index = BTreeMap::new();
    let mut duplicates = Vec::new();
    for (file, table) in tables {
        match table {
            Ok(table) => {
                for key in table.scenes.into_keys() {
                    match index.entry(key) {
                        Entry::Vacant(entry) => {
                            entry.insert(file.clone());
                        }
                        Entry::Occupied(first) => {
                            duplicates.push(format!("{} in {} and {file}", first.key(), first.get()));
                        }
                    }
                }
            }
            Err(error) => {
                report.num_scenes += 1;
                report.skip(file, error.to_string());
            }
        }
    }
    duplicates.sort_unstable();
    report.notes.extend(note_on(&duplicates, "in more than one file, the first of which is used"));
    let note = format!("no index.json: the scenes of {} files were determined from their contents", files.len());
    report.notes.push(note);
    index
}

fn torch_files(folder: &Path) -> Result<Vec<String>, DataError> {
    let mut files = file_names(folder)?;
    files.retain(|name| has_ending(name, "torch"));
    Ok(files)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sources::chunks::writer::{SceneRecord, scene_file_bytes};

    #[test]
    fn keys_may_end_in_the_file_extension() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.torch.torch");
        let (key, url) = ("a.torch".to_owned(), String::new());
        let scene = SceneRecord { key, url, timestamps: Vec::new(), cameras: Vec::new(), images: Vec::new() };
        std::fs::write(&path, scene_file_bytes(&path, &scene).unwrap()).unwrap();
        let mut report = SkipReport::default();
        let index = index_of_files(folder.path(), &mut report).unwrap();
        assert_eq!(index, BTreeMap::from([("a.torch".to_owned(), "a.torch.torch".to_owned())]));
        assert!(report.notes.is_empty(), "not read as a chunk: {report}");
    }
}
