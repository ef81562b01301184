//! The file of every scene in a folder of chunks or of one file per scene.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path};

use clift_core::{first_few, plural};
use rayon::prelude::*;

use crate::error::DataError;
use crate::files::bounded::{parse_json, read_bounded};
use crate::files::listing::{file_names, has_ending};
use crate::skip_report::SkipReport;
use crate::sources::chunks::table::{CHUNKS_PER_CALL, ChunkTable, ScanProgress};

/// Largest number of files that are tried for one that tells chunks from files of one scene.
const MAX_TRIED_FILES: usize = 8;
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

/// Returns the file of every scene of a folder without an index: by name for one file per scene, by contents for chunks.
pub(crate) fn index_of_files(
    folder: &Path,
    report: &mut SkipReport,
    progress: ScanProgress<'_>,
) -> Result<BTreeMap<String, String>, DataError> {
    let files = torch_files(folder)?;
    let stem = |file: &String| file.strip_suffix(".torch").unwrap_or(file).to_owned();
    let read = |file: &String| (file.clone(), ChunkTable::read(&folder.join(file)));
    let first = files.iter().take(MAX_TRIED_FILES).map(read).find_map(|(file, table)| Some((stem(&file), table.ok()?)));
    if first.is_none_or(|(key, table)| table.scenes.len() == 1 && table.scenes.contains_key(&key)) {
        return Ok(files.into_iter().map(|file| (stem(&file), file)).collect());
    }
    let (mut index, mut done) = (BTreeMap::new(), 0);
    for part in files.chunks(CHUNKS_PER_CALL) {
        let tables: Vec<_> = part.par_iter().map(read).collect();
        for (file, table) in tables {
            let mut skip = |key: &str, reason: &str| {
                report.num_scenes += 1;
                report.skip(key, reason);
            };
            let scenes = table.map(|table| table.scenes).inspect_err(|error| skip(&file, &error.to_string()));
            for key in scenes.unwrap_or_default().into_keys().collect::<BTreeSet<_>>() {
                match index.entry(key) {
                    Entry::Vacant(entry) => _ = entry.insert(file.clone()),
                    Entry::Occupied(first) => skip(first.key(), "also in an earlier file"),
                }
            }
        }
        done += part.len();
        progress(done, files.len());
    }
    let note = format!("no index.json: the scenes of {} files were determined from their contents", files.len());
    report.notes.push(note);
    Ok(index)
}

fn torch_files(folder: &Path) -> Result<Vec<String>, DataError> {
    let mut files = file_names(folder)?;
    files.retain(|name| has_ending(name, "torch"));
    Ok(files)
}
