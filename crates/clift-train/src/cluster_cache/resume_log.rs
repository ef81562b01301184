//! Log of the finished entries of a cluster cache, from which an interrupted build resumes.
//!
//! Every context set is a line of `journal.jsonl`; a torn line is made again. The finished cache is written from them.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader, BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use clift_core::{make_folder, publish_folder, replace_file};
use clift_data::SkipReport;
use serde::{Deserialize, Serialize};

use crate::cluster_cache::cache::{CacheEntry, CacheIndex, CacheSettings};
use crate::error::TrainError;

const WRITING: &str = "writing the cluster cache";
const DATA: &str = "clusters.bin";
const JOURNAL: &str = "journal.jsonl";

/// Inputs of a cache build. A build resumes only if they are equal. First line of the log.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct CacheKey {
    pub version: u32,
    pub encoder: String,
    pub settings: CacheSettings,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub(crate) enum Outcome {
    Clustered { key: String, context: Vec<usize>, tokens: Vec<u16>, centroids: Vec<u16> },
    Skipped { key: String, reason: String },
}

#[derive(Debug)]
pub(crate) struct ResumeLog {
    folder: PathBuf,
    cache_key: CacheKey,
    journal: File,
    num_sets: u64,
}

impl ResumeLog {
    /// Resumes the build in `folder`, or starts a new one if the folder has no log of `cache_key`.
    pub fn open(folder: &Path, cache_key: CacheKey) -> Result<Self, TrainError> {
        let failed = TrainError::io("resuming an unfinished cluster cache", folder);
        if let Some((journal, num_sets)) = resume(folder, &cache_key).map_err(failed)? {
            return Ok(Self { folder: folder.into(), cache_key, journal, num_sets });
        }
        if folder.exists() {
            std::fs::remove_dir_all(folder).map_err(TrainError::io("removing an unfinished cache", folder))?;
        }
        make_folder(folder).map_err(TrainError::io("making the cluster cache", folder))?;
        let path = folder.join(JOURNAL);
        let journal = File::create(&path).map_err(TrainError::io(WRITING, &path))?;
        let mut log = Self { folder: folder.into(), cache_key, journal, num_sets: 0 };
        log.write_line(&log.cache_key.clone())?;
        Ok(log)
    }

    pub fn num_sets(&self) -> u64 {
        self.num_sets
    }

    pub fn add(&mut self, outcome: &Outcome) -> Result<(), TrainError> {
        self.write_line(outcome)?;
        self.num_sets += 1;
        Ok(())
    }

    fn write_line(&mut self, line: &impl Serialize) -> Result<(), TrainError> {
        let path = self.folder.join(JOURNAL);
        let text = serde_json::to_string(line).map_err(TrainError::bad_file("cluster cache", &path))?;
        self.journal.write_all(format!("{text}\n").as_bytes()).map_err(TrainError::io(WRITING, &path))
    }

    /// Writes the data and the index of the finished cache, renames the folder to `path`, and removes the log.
    pub fn publish(self, path: &Path, num_scenes: usize) -> Result<(), TrainError> {
        let Self { folder, cache_key: CacheKey { version, encoder, settings }, .. } = self;
        let data = folder.join(DATA);
        let (entries, skipped) = write_data(&folder.join(JOURNAL), &data).map_err(TrainError::io(WRITING, &data))?;
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
        let index = CacheIndex { version, encoder, settings, skipped: report, entries };
        let index_path = folder.join("index.json");
        let text = serde_json::to_vec(&index).map_err(TrainError::bad_file("cluster cache", &index_path))?;
        replace_file(&index_path, &text).map_err(TrainError::io(WRITING, &index_path))?;
        publish_folder(&folder, path).map_err(TrainError::io("renaming the cluster cache", path))?;
        remove_resume_log(path)
    }
}

/// Counts the finished sets of an earlier process and removes an unfinished line. Returns the journal at its end, and `None`
/// without a journal of `cache_key`.
fn resume(folder: &Path, cache_key: &CacheKey) -> std::io::Result<Option<(File, u64)>> {
    let Ok(mut journal) = File::options().read(true).write(true).open(folder.join(JOURNAL)) else { return Ok(None) };
    let (mut reader, mut line, mut num_bytes, mut num_sets) = (BufReader::new(&journal), Vec::new(), 0, 0);
    reader.read_until(b'\n', &mut line)?;
    let is_whole = |line: &[u8]| line.ends_with(b"\n");
    if !is_whole(&line) || serde_json::from_slice(&line).ok().as_ref() != Some(cache_key) {
        return Ok(None);
    }
    loop {
        num_bytes += line.len() as u64;
        line.clear();
        reader.read_until(b'\n', &mut line)?;
        if !is_whole(&line) || serde_json::from_slice::<Outcome>(&line).is_err() {
            break;
        }
        num_sets += 1;
    }
    journal.set_len(num_bytes)?;
    journal.seek(SeekFrom::Start(num_bytes))?;
    Ok(Some((journal, num_sets)))
}

/// The keys of skipped scenes, with reasons, in the order of the journal.
type Skipped = Vec<(String, String)>;

/// Writes the clusters of a journal to `data`. Returns their entries and what was skipped.
fn write_data(journal: &Path, data: &Path) -> std::io::Result<(Vec<CacheEntry>, Skipped)> {
    let (mut entries, mut skipped) = (Vec::<CacheEntry>::new(), Skipped::new());
    let mut data = BufWriter::new(File::create(data)?);
    for line in BufReader::new(File::open(journal)?).lines().skip(1) {
        match serde_json::from_str(&line?)? {
            Outcome::Skipped { key, reason } => skipped.push((key, reason)),
            Outcome::Clustered { key, context, tokens, centroids } => {
                for id in tokens.iter().chain(&centroids) {
                    data.write_all(&id.to_le_bytes())?;
                }
                let offset_bytes = entries.last().map_or(0, |last| last.offset_bytes + last.num_bytes());
                let (num_tokens, num_storage_tokens) = (tokens.len(), centroids.len());
                entries.push(CacheEntry { key, context, num_tokens, num_storage_tokens, offset_bytes });
            }
        }
    }
    data.into_inner()?.sync_data()?;
    Ok((entries, skipped))
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

#[cfg(test)]
mod tests {
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

    /// Adds sets up to `until`: the third cannot be clustered, the others grow.
    fn add_sets(log: &mut ResumeLog, until: u64) {
        for set in log.num_sets()..until {
            let key = format!("scene {}", set % 4);
            let (context, tokens, centroids) = (vec![0, set as usize], vec![0; 2 + set as usize], vec![0]);
            log.add(&match set {
                2 => Outcome::Skipped { key, reason: "too short".into() },
                _ => Outcome::Clustered { key, context, tokens, centroids },
            })
            .unwrap();
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
        let lines = std::fs::read(folder.join(JOURNAL)).unwrap();
        let mut taken_over = std::collections::BTreeSet::new();
        let ends = lines.iter().enumerate().filter(|(_, byte)| **byte == b'\n').flat_map(|(end, _)| [end, end + 1]);
        for length in ends.chain((0..lines.len()).step_by(97)) {
            // A power cut may leave zeros.
            for torn in [&[][..], &[0; 40]] {
                std::fs::create_dir_all(&folder).unwrap();
                std::fs::write(folder.join(JOURNAL), [&lines[..length], torn].concat()).unwrap();
                taken_over.insert(ResumeLog::open(&folder, cache_key()).unwrap().num_sets());
                assert_eq!(finished(place.path()), expected, "{length}");
                std::fs::remove_dir_all(place.path().join("clusters")).unwrap();
            }
        }
        assert!(taken_over.into_iter().eq(0..=6), "complete sets are not built again");
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
        log.add(&Outcome::Skipped { key: "a".into(), reason: "too short".into() }).unwrap();
        let message = log.publish(&place.path().join("clusters"), 1).unwrap_err().to_string();
        assert!(message.contains("too short"), "{message}");
        assert_eq!(std::fs::read_dir(place.path()).unwrap().count(), 0);
    }
}
