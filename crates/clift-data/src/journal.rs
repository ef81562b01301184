//! `SHA256SUMS`: which files of a folder are complete, and what they hold.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use crate::error::DataError;
use crate::files::replace;

/// As `sha256sum` calls it: a line per file, sum and name.
const FILE_NAME: &str = "SHA256SUMS";

/// The sums of a folder that is being written.
pub(crate) struct Journal {
    folder: PathBuf,
    sums: BTreeMap<String, String>,
}

impl Journal {
    /// Starts a folder, or takes up one that was started. Lines of files that are missing or hold something else are
    /// dropped: they will be written again.
    pub fn open(folder: &Path) -> Result<Self, DataError> {
        std::fs::create_dir_all(folder).map_err(DataError::io("making the folder", folder))?;
        let path = folder.join(FILE_NAME);
        let mut sums = BTreeMap::new();
        if path.exists() {
            let text = std::fs::read_to_string(&path).map_err(DataError::io("reading the checksums", &path))?;
            // A line that was cut off has no end, and its file is written again.
            for line in text.split_inclusive('\n').filter_map(|line| line.strip_suffix('\n')) {
                let Some((sum, name)) = line.split_once("  ") else { continue };
                let file = folder.join(name);
                let is_inside = Path::new(name).file_name().is_some_and(|base| base == name);
                if is_inside && file.is_file() && hash(&file)? == sum {
                    sums.insert(name.to_owned(), sum.to_owned());
                }
            }
        } else {
            let mut entries = std::fs::read_dir(folder).map_err(DataError::io("reading the folder", folder))?;
            if let Some(Ok(entry)) = entries.next() {
                let name = entry.file_name().to_string_lossy().into_owned();
                let what = format!("it holds {name} and no {FILE_NAME}; choose an empty folder");
                return Err(DataError::BadIndex { what, path: folder.to_path_buf() });
            }
        }
        let journal = Self { folder: folder.to_path_buf(), sums };
        journal.rewrite()?;
        Ok(journal)
    }

    /// The files that are complete.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.sums.keys().map(String::as_str)
    }

    /// Notes a file that has just been written.
    pub fn add(&mut self, name: &str) -> Result<(), DataError> {
        let sum = hash(&self.folder.join(name))?;
        let line = format!("{sum}  {name}\n");
        if self.sums.insert(name.to_owned(), sum).is_some() {
            return self.rewrite();
        }
        let path = self.folder.join(FILE_NAME);
        let written = OpenOptions::new().append(true).open(&path).and_then(|mut file| {
            file.write_all(line.as_bytes())?;
            file.sync_data()
        });
        written.map_err(DataError::io("writing the checksums", &path))
    }

    fn rewrite(&self) -> Result<(), DataError> {
        let lines: Vec<String> = self.sums.iter().map(|(name, sum)| format!("{sum}  {name}\n")).collect();
        let path = self.folder.join(FILE_NAME);
        replace(&path, lines.concat().as_bytes()).map_err(DataError::io("writing the checksums", &path))
    }
}

/// SHA-256 of a file, in hexadecimal.
fn hash(path: &Path) -> Result<String, DataError> {
    let reading = || DataError::io("reading a file for its checksum", path);
    let mut file = File::open(path).map_err(reading())?;
    let mut digest = Sha256::new();
    let mut buffer = vec![0; 1 << 20];
    loop {
        match file.read(&mut buffer).map_err(reading())? {
            0 => break,
            count => digest.update(&buffer[..count]),
        }
    }
    let pairs: Vec<String> = digest.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
    Ok(pairs.concat())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sum_of_a_file_is_sha_256s() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        std::fs::write(&path, b"abc").unwrap();
        assert_eq!(hash(&path).unwrap(), "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
    }

    #[test]
    fn files_that_changed_and_lines_that_were_cut_are_forgotten() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let mut journal = Journal::open(folder.path()).unwrap();
        for name in ["a", "b", "c"] {
            std::fs::write(at(name), name).unwrap();
            journal.add(name).unwrap();
        }
        std::fs::write(at("a"), "changed").unwrap();
        std::fs::write(at("d"), "d").unwrap();
        let text = std::fs::read_to_string(at(FILE_NAME)).unwrap();
        std::fs::write(at(FILE_NAME), format!("{text}18ac3e7343f01689")).unwrap();
        let journal = Journal::open(folder.path()).unwrap();
        assert_eq!(journal.names().collect::<Vec<_>>(), ["b", "c"]);
        assert_eq!(std::fs::read_to_string(at(FILE_NAME)).unwrap().lines().count(), 2);
    }

    #[test]
    fn a_folder_with_something_else_in_it_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("thesis.txt"), "").unwrap();
        let message = Journal::open(folder.path()).err().unwrap().to_string();
        assert!(message.contains("it holds thesis.txt and no SHA256SUMS; choose an empty folder"), "{message}");
        assert!(!folder.path().join(FILE_NAME).exists());
    }
}
