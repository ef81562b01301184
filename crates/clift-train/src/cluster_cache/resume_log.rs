//! What is done of a cluster cache: a temporary folder that a killed process leaves and the next goes on with.
//!
//! Every set of contexts is a line of `journal.jsonl`, written after its bytes in `clusters.bin` and with a checksum of
//! both. What a kill or a power cut tore is found by that and made again.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use clift_data::{SkipReport, make_folder, publish_folder, replace_file};
use clift_model::SceneClusters;
use serde::{Deserialize, Serialize};

use crate::cluster_cache::entry::{CacheEntry, CacheIndex};
use crate::config::config::MAX_TOKENS;
use crate::error::TrainError;

const WRITING: &str = "writing the cluster cache";
const DATA: &str = "clusters.bin";
const JOURNAL: &str = "journal.jsonl";

/// What a cache is made from: only with the same is it gone on with. The first line of the journal.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct CacheKey {
    pub version: u32,
    /// Hash of the encoder's weights.
    pub encoder: String,
    /// The settings that decide the clusters.
    pub settings: String,
}

/// A further line: what became of one set.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Line {
    /// Number of the set.
    set: u64,
    outcome: Outcome,
    /// Of number and outcome as they are written here, and of the set's bytes.
    crc32: u32,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
enum Outcome {
    Clustered(CacheEntry),
    Skipped { key: String, reason: String },
}

impl Line {
    fn new(set: u64, outcome: Outcome, bytes: &[u8]) -> serde_json::Result<Self> {
        let mut hasher = crc32fast::Hasher::new();
        hasher.update(&serde_json::to_vec(&(set, &outcome))?);
        hasher.update(bytes);
        Ok(Self { set, outcome, crc32: hasher.finalize() })
    }
}

/// A cache that is being made.
#[derive(Debug)]
pub(crate) struct ResumeLog {
    folder: PathBuf,
    origin: CacheKey,
    data: File,
    lines: File,
    entries: Vec<CacheEntry>,
    skipped: Vec<(String, String)>,
}

impl ResumeLog {
    /// Goes on in `folder`, or starts anew where it holds nothing of this origin.
    ///
    /// # Errors
    /// [`TrainError::Io`].
    pub fn open(folder: &Path, origin: CacheKey) -> Result<Self, TrainError> {
        let failed = |source| TrainError::io("taking up an unfinished cluster cache", folder)(source);
        if let Some(journal) = Self::take_up(folder, &origin).map_err(failed)? {
            return Ok(journal);
        }
        if folder.exists() {
            std::fs::remove_dir_all(folder).map_err(TrainError::io("removing an unfinished cache", folder))?;
        }
        make_folder(folder).map_err(TrainError::io("making the cluster cache", folder))?;
        let create = |name: &str| File::create(folder.join(name)).map_err(TrainError::io(WRITING, &folder.join(name)));
        let (data, lines) = (create(DATA)?, create(JOURNAL)?);
        let mut journal = Self { folder: folder.into(), origin, data, lines, entries: Vec::new(), skipped: Vec::new() };
        journal.write_line(&journal.origin.clone())?;
        Ok(journal)
    }

    /// Reads what an earlier process has done and cuts off what it left half done.
    fn take_up(folder: &Path, origin: &CacheKey) -> std::io::Result<Option<Self>> {
        let open = |name: &str| File::options().read(true).write(true).open(folder.join(name));
        let (Ok(mut data), Ok(mut lines)) = (open(DATA), open(JOURNAL)) else { return Ok(None) };
        let (mut entries, mut skipped) = (Vec::new(), Vec::new());
        let (mut num_bytes, mut num_line_bytes) = (0, 0);
        let mut reader = BufReader::new(&lines);
        let mut text = Vec::new();
        reader.read_until(b'\n', &mut text)?;
        if !serde_json::from_slice::<CacheKey>(&text).is_ok_and(|found| found == *origin && text.ends_with(b"\n")) {
            return Ok(None);
        }
        loop {
            num_line_bytes += text.len() as u64;
            text.clear();
            reader.read_until(b'\n', &mut text)?;
            if !text.ends_with(b"\n") {
                break;
            }
            let Ok(Line { set, outcome, crc32 }) = serde_json::from_slice(&text) else { break };
            let mut bytes = Vec::new();
            if let Outcome::Clustered(entry) = &outcome {
                Read::by_ref(&mut data).take(entry.num_bytes()).read_to_end(&mut bytes)?;
            }
            let expected = Line::new((entries.len() + skipped.len()) as u64, outcome, &bytes)?;
            if (set, crc32) != (expected.set, expected.crc32) {
                break;
            }
            match expected.outcome {
                Outcome::Clustered(entry) => {
                    num_bytes += entry.num_bytes();
                    entries.push(entry);
                }
                Outcome::Skipped { key, reason } => skipped.push((key, reason)),
            }
        }
        drop(reader);
        for (file, length) in [(&mut data, num_bytes), (&mut lines, num_line_bytes)] {
            file.set_len(length)?;
            file.seek(SeekFrom::Start(length))?;
        }
        Ok(Some(Self { folder: folder.into(), origin: origin.clone(), data, lines, entries, skipped }))
    }

    /// How many sets are done.
    pub fn num_sets(&self) -> u64 {
        (self.entries.len() + self.skipped.len()) as u64
    }

    /// Adds the clusters of the next set.
    ///
    /// # Errors
    /// [`TrainError::Io`], and [`TrainError::NoScenes`] for more tokens than 16 bits can name.
    pub fn add(&mut self, key: &str, context: Vec<usize>, clusters: &SceneClusters) -> Result<(), TrainError> {
        let bytes = encode(clusters)?;
        let entry = CacheEntry {
            key: key.into(),
            context,
            num_tokens: clusters.assignment().len(),
            num_storage_tokens: clusters.centroid_index().len(),
            offset_bytes: self.entries.last().map_or(0, |last| last.offset_bytes + last.num_bytes()),
        };
        self.data.write_all(&bytes).map_err(TrainError::io(WRITING, &self.folder.join(DATA)))?;
        self.write_outcome(Outcome::Clustered(entry.clone()), &bytes)?;
        self.entries.push(entry);
        Ok(())
    }

    /// Notes that the next set could not be clustered.
    ///
    /// # Errors
    /// [`TrainError::Io`].
    pub fn skip(&mut self, key: &str, reason: &str) -> Result<(), TrainError> {
        self.write_outcome(Outcome::Skipped { key: key.into(), reason: reason.into() }, &[])?;
        self.skipped.push((key.into(), reason.into()));
        Ok(())
    }

    fn write_outcome(&mut self, outcome: Outcome, bytes: &[u8]) -> Result<(), TrainError> {
        let line = Line::new(self.num_sets(), outcome, bytes);
        self.write_line(&line.map_err(TrainError::bad_file("cluster cache", &self.folder.join(JOURNAL)))?)
    }

    fn write_line(&mut self, line: &impl Serialize) -> Result<(), TrainError> {
        let path = self.folder.join(JOURNAL);
        let text = serde_json::to_string(line).map_err(TrainError::bad_file("cluster cache", &path))?;
        self.lines.write_all(format!("{text}\n").as_bytes()).map_err(TrainError::io(WRITING, &path))
    }

    /// Writes the index of the finished cache and gives it its name. The journal is left out.
    ///
    /// # Errors
    /// [`TrainError::Io`], and [`TrainError::NoScenes`] for an empty cache.
    pub fn publish(self, path: &Path, num_scenes: usize) -> Result<(), TrainError> {
        let Self { folder, origin, data, lines, entries, skipped } = self;
        if entries.is_empty() {
            // Kept, it would refuse the same scenes again after their files are mended.
            std::fs::remove_dir_all(&folder).map_err(TrainError::io("removing an empty cache", &folder))?;
            let reason = skipped.into_iter().next().map(|(_, reason)| reason).unwrap_or_default();
            return Err(TrainError::NoScenes { reason: format!("none could be clustered; the first: {reason}") });
        }
        let mut reasons: BTreeMap<String, String> = skipped.into_iter().collect();
        // A scene that one pass could use is not left out.
        for entry in &entries {
            reasons.remove(&entry.key);
        }
        let mut ledger = SkipReport::new(num_scenes);
        for (key, reason) in reasons {
            ledger.skip(key, reason);
        }
        let CacheKey { version, encoder, settings } = origin;
        let index = CacheIndex { version, encoder, settings, skipped: ledger, entries };
        let index_path = folder.join("index.json");
        let text = serde_json::to_vec(&index).map_err(TrainError::bad_file("cluster cache", &index_path))?;
        replace_file(&index_path, &text).map_err(TrainError::io(WRITING, &index_path))?;
        drop((data, lines));
        publish_folder(&folder, path).map_err(TrainError::io("renaming the cluster cache", path))?;
        remove_journal(path)
    }
}

/// Removes the journal of a finished cache; a kill may have left it there.
///
/// # Errors
/// [`TrainError::Io`].
pub(crate) fn remove_journal(cache: &Path) -> Result<(), TrainError> {
    let path = cache.join(JOURNAL);
    match std::fs::remove_file(&path) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            Err(TrainError::io("removing the journal of a finished cluster cache", &path)(error))
        }
        _ => Ok(()),
    }
}

fn encode(clusters: &SceneClusters) -> Result<Vec<u8>, TrainError> {
    let ids = clusters.assignment().iter().chain(clusters.centroid_index());
    ids.map(|&id| u16::try_from(id).map(u16::to_le_bytes))
        .collect::<Result<Vec<_>, _>>()
        .map(|pairs| pairs.concat())
        .map_err(|_| TrainError::NoScenes { reason: format!("a scene has more than {MAX_TOKENS} tokens") })
}

#[cfg(test)]
mod tests {
    use clift_data::item_rng;
    use rand::RngExt;

    use super::*;

    fn origin() -> CacheKey {
        CacheKey { version: 1, encoder: "abc".into(), settings: "{}".into() }
    }

    /// Sets of a scene whose tokens all belong to the first cluster or are it.
    fn clusters(num_tokens: usize) -> SceneClusters {
        SceneClusters::new(vec![0; num_tokens], vec![0]).unwrap()
    }

    /// Does the sets from where the journal stands, 8 in all: the third cannot be clustered, the others grow.
    fn go_on(journal: &mut ResumeLog, until: u64) {
        for set in journal.num_sets()..until {
            let key = format!("scene {}", set % 4);
            if set == 2 {
                journal.skip(&key, "too short").unwrap();
            } else {
                journal.add(&key, vec![0, set as usize], &clusters(2 + set as usize)).unwrap();
            }
        }
    }

    fn finished(place: &Path) -> [Vec<u8>; 2] {
        let mut journal = ResumeLog::open(&place.join("clusters.tmp"), origin()).unwrap();
        go_on(&mut journal, 8);
        journal.publish(&place.join("clusters"), 4).unwrap();
        assert_eq!(std::fs::read_dir(place.join("clusters")).unwrap().count(), 2, "the journal is gone");
        assert!(!place.join("clusters.tmp").exists());
        [DATA, "index.json"].map(|name| std::fs::read(place.join("clusters").join(name)).unwrap())
    }

    #[test]
    fn a_journal_cut_off_anywhere_gives_the_same_cache() {
        let whole = tempfile::tempdir().unwrap();
        let expected = finished(whole.path());
        let place = tempfile::tempdir().unwrap();
        let folder = place.path().join("clusters.tmp");
        go_on(&mut ResumeLog::open(&folder, origin()).unwrap(), 6);
        let [data, lines] = [DATA, JOURNAL].map(|name| std::fs::read(folder.join(name)).unwrap());
        let mut taken_over = std::collections::BTreeSet::new();
        let ends = lines.iter().enumerate().filter(|(_, byte)| **byte == b'\n').flat_map(|(end, _)| [end, end + 1]);
        for length in ends.chain((0..lines.len()).step_by(97)) {
            // The data of a line is written before it; a power cut may lose some all the same.
            for data_length in [data.len(), data.len() * length / lines.len(), 0] {
                std::fs::create_dir_all(&folder).unwrap();
                std::fs::write(folder.join(JOURNAL), &lines[..length]).unwrap();
                std::fs::write(folder.join(DATA), &data[..data_length]).unwrap();
                taken_over.insert(ResumeLog::open(&folder, origin()).unwrap().num_sets());
                assert_eq!(finished(place.path()), expected, "{length}, {data_length}");
                std::fs::remove_dir_all(place.path().join("clusters")).unwrap();
            }
        }
        assert!(taken_over.into_iter().eq(0..=6), "nothing that is whole is made again");
    }

    #[test]
    fn damaged_bytes_and_those_after_them_are_made_again() {
        let whole = tempfile::tempdir().unwrap();
        let expected = finished(whole.path());
        let place = tempfile::tempdir().unwrap();
        let folder = place.path().join("clusters.tmp");
        go_on(&mut ResumeLog::open(&folder, origin()).unwrap(), 6);
        let mut data = std::fs::read(folder.join(DATA)).unwrap();
        data[7] ^= 1; // of the second set: the first has three numbers of two bytes
        std::fs::write(folder.join(DATA), data).unwrap();
        assert_eq!(ResumeLog::open(&folder, origin()).unwrap().num_sets(), 1);
        assert_eq!(finished(place.path()), expected);
    }

    #[test]
    fn what_is_taken_up_of_a_journal_damaged_anyhow_is_whole_and_the_first_of_it() {
        let place = tempfile::tempdir().unwrap();
        let folder = place.path().join("clusters.tmp");
        go_on(&mut ResumeLog::open(&folder, origin()).unwrap(), 6);
        let files = [DATA, JOURNAL].map(|name| std::fs::read(folder.join(name)).unwrap());
        let whole = ResumeLog::open(&folder, origin()).unwrap();
        let mut taken_up = BTreeMap::new();
        for case in 0..2_000 {
            let mut rng = item_rng(0, 0, case, 0, "damage");
            for (name, bytes) in [DATA, JOURNAL].into_iter().zip(&files) {
                let mut bytes = bytes.clone();
                for _ in 0..rng.random_range(0..3) {
                    let at = rng.random_range(0..bytes.len());
                    match rng.random_range(0..4) {
                        0 => bytes[at] ^= 1 << rng.random_range(0..8),
                        1 => bytes[at] = b"\n\",{}0"[rng.random_range(0..6)],
                        2 => drop(bytes.drain(at..(at + rng.random_range(1..40)).min(bytes.len()))),
                        _ => bytes.extend_from_within(at..),
                    }
                }
                std::fs::create_dir_all(&folder).unwrap();
                std::fs::write(folder.join(name), bytes).unwrap();
            }
            let journal = ResumeLog::open(&folder, origin()).unwrap();
            assert_eq!(journal.entries, whole.entries[..journal.entries.len()], "case {case}");
            assert_eq!(journal.skipped, whole.skipped[..journal.skipped.len()], "case {case}");
            let data = std::fs::read(folder.join(DATA)).unwrap();
            assert_eq!(data, files[0][..data.len()], "case {case}");
            *taken_up.entry(journal.num_sets()).or_insert(0) += 1;
        }
        assert!(taken_up.keys().copied().eq(0..=6) && taken_up[&6] > 200, "{taken_up:?}");
    }

    #[test]
    fn a_journal_of_another_origin_is_not_gone_on_with() {
        let place = tempfile::tempdir().unwrap();
        let folder = place.path().join("clusters.tmp");
        go_on(&mut ResumeLog::open(&folder, origin()).unwrap(), 3);
        assert_eq!(ResumeLog::open(&folder, origin()).unwrap().num_sets(), 3);
        let other = CacheKey { encoder: "abd".into(), ..origin() };
        assert_eq!(ResumeLog::open(&folder, other).unwrap().num_sets(), 0);
        assert_eq!(ResumeLog::open(&folder, origin()).unwrap().num_sets(), 0, "and what was there is gone");
    }

    #[test]
    fn a_cache_without_a_scene_is_refused_with_the_first_reason() {
        let place = tempfile::tempdir().unwrap();
        let mut journal = ResumeLog::open(&place.path().join("clusters.tmp"), origin()).unwrap();
        journal.skip("a", "too short").unwrap();
        let message = journal.publish(&place.path().join("clusters"), 1).unwrap_err().to_string();
        assert!(message.contains("too short"), "{message}");
        assert_eq!(std::fs::read_dir(place.path()).unwrap().count(), 0);
    }
}
