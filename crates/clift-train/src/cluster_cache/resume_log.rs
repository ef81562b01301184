//! Log of the finished entries of a cluster cache, from which an interrupted build resumes.
//!
//! Every context set is a line of `journal.jsonl`, written after its bytes in `clusters.bin` and with a checksum of both.
//! Torn entries are found by their checksums and built again.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use clift_core::{make_folder, publish_folder, replace_file};
use clift_data::SkipReport;
use clift_model::SceneClusters;
use serde::{Deserialize, Serialize};

use crate::cluster_cache::cache::{CacheEntry, CacheIndex, CacheSettings};
use crate::config::config::MAX_TOKENS;
use crate::error::TrainError;

const WRITING: &str = "writing the cluster cache";
const DATA: &str = "clusters.bin";
const JOURNAL: &str = "journal.jsonl";

/// Inputs of a cache build. A build resumes only if they are equal. First line of the log.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct CacheKey {
    pub version: u32,
    /// Hash of the encoder's weights.
    pub encoder: String,
    pub settings: CacheSettings,
}

/// A further line: the outcome of a context set.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Line {
    set: u64,
    outcome: Outcome,
    /// Checksum of index, outcome and bytes of the set.
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

/// A cluster cache during its build.
#[derive(Debug)]
pub(crate) struct ResumeLog {
    folder: PathBuf,
    cache_key: CacheKey,
    data: File,
    lines: File,
    entries: Vec<CacheEntry>,
    skipped: Vec<(String, String)>,
}

impl ResumeLog {
    /// Resumes the build in `folder`, or starts a new one if the folder has no log of `cache_key`.
    pub fn open(folder: &Path, cache_key: CacheKey) -> Result<Self, TrainError> {
        let failed = |source| TrainError::io("resuming an unfinished cluster cache", folder)(source);
        if let Some(log) = Self::resume(folder, &cache_key).map_err(failed)? {
            return Ok(log);
        }
        if folder.exists() {
            std::fs::remove_dir_all(folder).map_err(TrainError::io("removing an unfinished cache", folder))?;
        }
        make_folder(folder).map_err(TrainError::io("making the cluster cache", folder))?;
        let create = |name: &str| File::create(folder.join(name)).map_err(TrainError::io(WRITING, &folder.join(name)));
        let (data, lines) = (create(DATA)?, create(JOURNAL)?);
        let mut log = Self { folder: folder.into(), cache_key, data, lines, entries: Vec::new(), skipped: Vec::new() };
        log.write_line(&log.cache_key.clone())?;
        Ok(log)
    }

    /// Reads the finished sets of an earlier process and removes an unfinished one.
    fn resume(folder: &Path, cache_key: &CacheKey) -> std::io::Result<Option<Self>> {
        let open = |name: &str| File::options().read(true).write(true).open(folder.join(name));
        let (Ok(mut data), Ok(mut lines)) = (open(DATA), open(JOURNAL)) else { return Ok(None) };
        let (mut entries, mut skipped) = (Vec::new(), Vec::new());
        let (mut num_bytes, mut num_line_bytes) = (0, 0);
        let mut reader = BufReader::new(&lines);
        let mut text = Vec::new();
        reader.read_until(b'\n', &mut text)?;
        if !serde_json::from_slice::<CacheKey>(&text).is_ok_and(|found| found == *cache_key && text.ends_with(b"\n")) {
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
        Ok(Some(Self { folder: folder.into(), cache_key: cache_key.clone(), data, lines, entries, skipped }))
    }

    pub fn num_sets(&self) -> u64 {
        (self.entries.len() + self.skipped.len()) as u64
    }

    pub fn add(&mut self, key: &str, context: Vec<usize>, clusters: &SceneClusters) -> Result<(), TrainError> {
        let bytes = encode_clusters(clusters)?;
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

    /// Logs that the next set could not be clustered.
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

    /// Writes the index of the finished cache, renames the folder to `path`, and removes the log.
    pub fn publish(self, path: &Path, num_scenes: usize) -> Result<(), TrainError> {
        let Self { folder, cache_key, data, lines, entries, skipped } = self;
        if entries.is_empty() {
            // A kept log would skip the same scenes again after their files are repaired.
            std::fs::remove_dir_all(&folder).map_err(TrainError::io("removing an empty cache", &folder))?;
            let reason = skipped.into_iter().next().map(|(_, reason)| reason).unwrap_or_default();
            return Err(TrainError::NoScenes { reason: format!("none could be clustered; the first error: {reason}") });
        }
        let mut reasons: BTreeMap<String, String> = skipped.into_iter().collect();
        // A scene is skipped only if no pass could use it.
        for entry in &entries {
            reasons.remove(&entry.key);
        }
        let mut report = SkipReport::new(num_scenes);
        for (key, reason) in reasons {
            report.skip(key, reason);
        }
        let CacheKey { version, encoder, settings } = cache_key;
        let index = CacheIndex { version, encoder, settings, skipped: report, entries };
        let index_path = folder.join("index.json");
        let text = serde_json::to_vec(&index).map_err(TrainError::bad_file("cluster cache", &index_path))?;
        replace_file(&index_path, &text).map_err(TrainError::io(WRITING, &index_path))?;
        drop((data, lines));
        publish_folder(&folder, path).map_err(TrainError::io("renaming the cluster cache", path))?;
        remove_resume_log(path)
    }
}

/// Removes the log of a finished cache, which a killed process may have left.
pub(crate) fn remove_resume_log(cache: &Path) -> Result<(), TrainError> {
    let path = cache.join(JOURNAL);
    match std::fs::remove_file(&path) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            Err(TrainError::io("removing the log of a finished cluster cache", &path)(error))
        }
        _ => Ok(()),
    }
}

fn encode_clusters(clusters: &SceneClusters) -> Result<Vec<u8>, TrainError> {
    let ids = clusters.assignment().iter().chain(clusters.centroid_index());
    ids.map(|&id| u16::try_from(id).map(u16::to_le_bytes))
        .collect::<Result<Vec<_>, _>>()
        .map(|pairs| pairs.concat())
        .map_err(|_| TrainError::NoScenes { reason: format!("a scene has more than {MAX_TOKENS} tokens") })
}

#[cfg(test)]
mod tests {
    use clift_core::item_rng;
    use rand::RngExt;

    use super::*;
    use crate::config::config::Config;

    fn cache_key() -> CacheKey {
        CacheKey { version: 1, encoder: "abc".into(), settings: CacheSettings::new(&Config::default()) }
    }

    fn new_build() -> (tempfile::TempDir, PathBuf) {
        let place = tempfile::tempdir().unwrap();
        let folder = place.path().join("clusters.tmp");
        (place, folder)
    }

    fn clusters(num_tokens: usize) -> SceneClusters {
        SceneClusters::new(vec![0; num_tokens], vec![0]).unwrap()
    }

    /// Adds sets up to `until`: the third cannot be clustered, the others grow.
    fn add_sets(log: &mut ResumeLog, until: u64) {
        for set in log.num_sets()..until {
            let key = format!("scene {}", set % 4);
            if set == 2 {
                log.skip(&key, "too short").unwrap();
            } else {
                log.add(&key, vec![0, set as usize], &clusters(2 + set as usize)).unwrap();
            }
        }
    }

    fn finished(place: &Path) -> [Vec<u8>; 2] {
        let mut log = ResumeLog::open(&place.join("clusters.tmp"), cache_key()).unwrap();
        add_sets(&mut log, 8);
        log.publish(&place.join("clusters"), 4).unwrap();
        assert_eq!(std::fs::read_dir(place.join("clusters")).unwrap().count(), 2, "without the log");
        assert!(!place.join("clusters.tmp").exists());
        [DATA, "index.json"].map(|name| std::fs::read(place.join("clusters").join(name)).unwrap())
    }

    #[test]
    fn log_cut_anywhere_gives_the_same_cache() {
        let whole = tempfile::tempdir().unwrap();
        let expected = finished(whole.path());
        let (place, folder) = new_build();
        add_sets(&mut ResumeLog::open(&folder, cache_key()).unwrap(), 6);
        let [data, lines] = [DATA, JOURNAL].map(|name| std::fs::read(folder.join(name)).unwrap());
        let mut taken_over = std::collections::BTreeSet::new();
        let ends = lines.iter().enumerate().filter(|(_, byte)| **byte == b'\n').flat_map(|(end, _)| [end, end + 1]);
        for length in ends.chain((0..lines.len()).step_by(97)) {
            // The data of a line is written before it; a power cut may lose some all the same.
            for data_length in [data.len(), data.len() * length / lines.len(), 0] {
                std::fs::create_dir_all(&folder).unwrap();
                std::fs::write(folder.join(JOURNAL), &lines[..length]).unwrap();
                std::fs::write(folder.join(DATA), &data[..data_length]).unwrap();
                taken_over.insert(ResumeLog::open(&folder, cache_key()).unwrap().num_sets());
                assert_eq!(finished(place.path()), expected, "{length}, {data_length}");
                std::fs::remove_dir_all(place.path().join("clusters")).unwrap();
            }
        }
        assert!(taken_over.into_iter().eq(0..=6), "complete sets are not built again");
    }

    #[test]
    fn sets_of_a_damaged_log_are_a_prefix() {
        let (_place, folder) = new_build();
        add_sets(&mut ResumeLog::open(&folder, cache_key()).unwrap(), 6);
        let files = [DATA, JOURNAL].map(|name| std::fs::read(folder.join(name)).unwrap());
        let whole = ResumeLog::open(&folder, cache_key()).unwrap();
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
            let log = ResumeLog::open(&folder, cache_key()).unwrap();
            assert_eq!(log.entries, whole.entries[..log.entries.len()], "case {case}");
            assert_eq!(log.skipped, whole.skipped[..log.skipped.len()], "case {case}");
            let data = std::fs::read(folder.join(DATA)).unwrap();
            assert_eq!(data, files[0][..data.len()], "case {case}");
            *taken_up.entry(log.num_sets()).or_insert(0) += 1;
        }
        assert!(taken_up.keys().copied().eq(0..=6) && taken_up[&6] > 200, "{taken_up:?}");
    }

    #[test]
    fn log_of_other_inputs_is_discarded() {
        let (_place, folder) = new_build();
        add_sets(&mut ResumeLog::open(&folder, cache_key()).unwrap(), 3);
        assert_eq!(ResumeLog::open(&folder, cache_key()).unwrap().num_sets(), 3);
        let other = CacheKey { encoder: "abd".into(), ..cache_key() };
        assert_eq!(ResumeLog::open(&folder, other).unwrap().num_sets(), 0);
        assert_eq!(ResumeLog::open(&folder, cache_key()).unwrap().num_sets(), 0, "the former log was removed");
    }

    #[test]
    fn empty_cache_is_refused_with_the_first_reason() {
        let place = tempfile::tempdir().unwrap();
        let mut log = ResumeLog::open(&place.path().join("clusters.tmp"), cache_key()).unwrap();
        log.skip("a", "too short").unwrap();
        let message = log.publish(&place.path().join("clusters"), 1).unwrap_err().to_string();
        assert!(message.contains("too short"), "{message}");
        assert_eq!(std::fs::read_dir(place.path()).unwrap().count(), 0);
    }
}
