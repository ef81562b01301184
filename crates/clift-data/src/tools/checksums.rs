//! `SHA256SUMS`: the complete files of a conversion in progress, their checksums, and the options of the conversion.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Read, Write};
use std::path::{Path, PathBuf};

use clift_core::{TEMPORARY, replace_file};
use sha2::{Digest, Sha256};

use crate::error::DataError;
use crate::files::listing::has_ending;

/// Name of the file, in the format of `sha256sum`: a line per file with checksum and name.
const FILE_NAME: &str = "SHA256SUMS";
/// Start of the line with the options of the conversion, a comment for `sha256sum -c`.
const MADE_AS: &str = "# made as: ";
/// Name of the file that maps scene keys to chunks.
pub(crate) const INDEX: &str = "index.json";
/// Name of the file with the [`SkipReport`](crate::skip_report::SkipReport) of the conversion.
pub(crate) const SKIPPED: &str = "skipped.json";
/// Name of the file with the unreadable images of the folder.
pub(crate) const UNREADABLE: &str = "unreadable.json";
/// Files beside the scenes.
const LISTS: [&str; 3] = [INDEX, SKIPPED, UNREADABLE];

/// The checksums of a folder in progress.
///
/// The line of a file is on disk before the file has its name. A file without a line is therefore not from a
/// conversion.
#[derive(Debug)]
pub(crate) struct Checksums {
    folder: PathBuf,
    /// Options of the conversion, on one line.
    made_as: String,
    sums: BTreeMap<String, String>,
    /// Files whose checksum does not match their line.
    damaged: BTreeSet<String>,
}

impl Checksums {
    /// Reads the sums of a new, empty or unfinished folder without changing it. Drops lines of missing or bad files.
    pub fn open(folder: &Path, made_as: &str) -> Result<Self, DataError> {
        let bad = |what: String| DataError::BadOutput { what, path: folder.to_path_buf() };
        let path = folder.join(FILE_NAME);
        let mut checksums = Self {
            folder: folder.to_path_buf(),
            made_as: made_as.to_owned(),
            sums: BTreeMap::new(),
            damaged: BTreeSet::new(),
        };
        let mut found = None;
        if path.exists() {
            let text = std::fs::read_to_string(&path).map_err(DataError::io("reading the checksums", &path))?;
            // A truncated line has no line end, and its file does not exist yet.
            let lines: Vec<&str> = text.split_inclusive('\n').filter_map(|line| line.strip_suffix('\n')).collect();
            found = lines.iter().find_map(|line| line.strip_prefix(MADE_AS)).map(str::to_owned);
            if found.is_none() {
                return Err(bad(format!(
                    "the {FILE_NAME} is not from a conversion: it has no line `{}`; choose another folder",
                    MADE_AS.trim_end()
                )));
            }
            for (sum, name) in lines.iter().filter_map(|line| line.split_once("  ")) {
                let file = folder.join(name);
                let is_inside = Path::new(name).file_name().is_some_and(|base| base == name);
                if !is_inside || !file.is_file() {
                    continue;
                }
                if hash_file(&file)? == sum {
                    checksums.damaged.remove(name);
                    checksums.sums.insert(name.to_owned(), sum.to_owned());
                } else if !checksums.sums.contains_key(name) {
                    checksums.damaged.insert(name.to_owned());
                }
            }
        }
        checksums.refuse_others()?;
        let has_scenes = checksums.sums.keys().chain(&checksums.damaged).any(|name| has_ending(name, "torch"));
        match found {
            Some(found) if found != made_as && has_scenes => Err(bad(format!(
                "its files were made as: {found}; requested: {made_as}; use the same options or choose another folder"
            ))),
            _ => Ok(checksums),
        }
    }

    /// Refuses a folder with a file without a line, and with a damaged file that no conversion writes.
    fn refuse_others(&self) -> Result<(), DataError> {
        let folder = &self.folder;
        let bad = |what: String| DataError::BadOutput { what, path: folder.clone() };
        let reading = || DataError::io("reading the folder", folder);
        if let Some(name) =
            self.damaged.iter().find(|name| !has_ending(name, "torch") && !LISTS.contains(&name.as_str()))
        {
            return Err(bad(format!("the checksum of {name} differs from {FILE_NAME}; choose an empty folder")));
        }
        let entries = match std::fs::read_dir(folder) {
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(()),
            entries => entries.map_err(reading())?,
        };
        for entry in entries {
            let name = entry.map_err(reading())?.file_name().to_string_lossy().into_owned();
            let is_ours = name == FILE_NAME || name.starts_with(TEMPORARY);
            if !is_ours && !self.sums.contains_key(&name) && !self.damaged.contains(&name) {
                let what = format!("it holds {name}, which is not listed in {FILE_NAME}; choose an empty folder");
                return Err(bad(what));
            }
        }
        Ok(())
    }

    /// Creates the folder if necessary, and removes temporary files of killed processes and damaged files.
    pub fn begin(&mut self) -> Result<(), DataError> {
        std::fs::create_dir_all(&self.folder).map_err(DataError::io("making the folder", &self.folder))?;
        self.remove_leftovers().map_err(DataError::io("removing temporary files", &self.folder))?;
        for name in std::mem::take(&mut self.damaged) {
            self.delete(&name)?;
        }
        self.rewrite()
    }

    /// Returns the names of the complete files.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.sums.keys().map(String::as_str)
    }

    /// Writes the line of a file, then the file.
    pub fn write(&mut self, name: &str, bytes: &[u8]) -> Result<(), DataError> {
        let sum = hex::encode(Sha256::digest(bytes));
        let line = format!("{sum}  {name}\n");
        if self.sums.insert(name.to_owned(), sum).is_some() {
            self.rewrite()?;
        } else {
            let path = self.folder.join(FILE_NAME);
            let written = OpenOptions::new().append(true).open(&path).and_then(|mut file| {
                file.write_all(line.as_bytes())?;
                file.sync_data()
            });
            written.map_err(DataError::io("writing the checksums", &path))?;
        }
        let path = self.folder.join(name);
        replace_file(&path, bytes).map_err(DataError::io("writing a file", &path))
    }

    /// Removes the files of these names that are listed, and their lines.
    pub fn remove_all<'a>(&mut self, names: impl IntoIterator<Item = &'a str>) -> Result<(), DataError> {
        let names: Vec<&str> = names.into_iter().filter(|name| self.sums.contains_key(*name)).collect();
        if names.is_empty() {
            return Ok(());
        }
        for name in names {
            // The file goes first: a kill leaves a line without a file, never a file without a line.
            self.delete(name)?;
            self.sums.remove(name);
        }
        self.rewrite()
    }

    /// Removes the temporary files of this folder, but not of subfolders.
    fn remove_leftovers(&self) -> std::io::Result<()> {
        for entry in std::fs::read_dir(&self.folder)? {
            let entry = entry?;
            if entry.file_name().to_string_lossy().starts_with(TEMPORARY) && entry.file_type()?.is_file() {
                std::fs::remove_file(entry.path())?;
            }
        }
        Ok(())
    }

    fn delete(&self, name: &str) -> Result<(), DataError> {
        let path = self.folder.join(name);
        std::fs::remove_file(&path).map_err(DataError::io("removing an outdated file", &path))
    }

    fn rewrite(&self) -> Result<(), DataError> {
        let lines = self.sums.iter().map(|(name, sum)| format!("{sum}  {name}\n"));
        let text: String = std::iter::once(format!("{MADE_AS}{}\n", self.made_as)).chain(lines).collect();
        let path = self.folder.join(FILE_NAME);
        replace_file(&path, text.as_bytes()).map_err(DataError::io("writing the checksums", &path))
    }
}

/// Returns the SHA-256 of a file in hexadecimal.
///
/// # Errors
/// [`DataError::Io`].
pub fn hash_file(path: &Path) -> Result<String, DataError> {
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
    Ok(hex::encode(digest.finalize()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn checksums_are_sha256() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        std::fs::write(&path, b"abc").unwrap();
        assert_eq!(hash_file(&path).unwrap(), "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
        let mut checksums = Checksums::open(&folder.path().join("out"), "chunks").unwrap();
        checksums.begin().unwrap();
        checksums.write("a", b"abc").unwrap();
        assert_eq!(checksums.sums["a"], hash_file(&path).unwrap());
    }

    fn three(folder: &Path) {
        let mut checksums = Checksums::open(folder, "chunks").unwrap();
        checksums.begin().unwrap();
        for name in ["a.torch", "b.torch", "c.torch"] {
            checksums.write(name, name.as_bytes()).unwrap();
        }
    }

    #[test]
    fn damaged_files_and_truncated_lines_are_dropped() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        three(folder.path());
        std::fs::write(at("a.torch"), "changed").unwrap();
        let text = std::fs::read_to_string(at(FILE_NAME)).unwrap();
        // A kill between line and file, and one within a line.
        let unwritten = format!("{}  d.torch\n", hex::encode(Sha256::digest(b"d")));
        std::fs::write(at(FILE_NAME), format!("{text}{unwritten}18ac3e7343f01689")).unwrap();
        let mut checksums = Checksums::open(folder.path(), "chunks").unwrap();
        assert_eq!(checksums.names().collect::<Vec<_>>(), ["b.torch", "c.torch"]);
        assert!(at("a.torch").exists(), "opening changes nothing");
        checksums.begin().unwrap();
        assert!(!at("a.torch").exists());
        checksums.remove_all(["b.torch", "never.torch"]).unwrap();
        let text = std::fs::read_to_string(at(FILE_NAME)).unwrap();
        assert_eq!(text.lines().count(), 2);
        assert!(text.starts_with("# made as: chunks\n") && text.ends_with("  c.torch\n"), "{text}");
        assert!(!at("b.torch").exists());
    }

    #[test]
    fn folder_with_other_files_is_refused_unchanged() {
        let folder = tempfile::tempdir().unwrap();
        let refused = |name: &str| {
            std::fs::write(folder.path().join(name), "").unwrap();
            let message = Checksums::open(folder.path(), "chunks").unwrap_err().to_string();
            std::fs::remove_file(folder.path().join(name)).unwrap();
            assert!(message.contains(&format!("it holds {name}, which is not listed in SHA256SUMS")), "{message}");
        };
        refused("thesis.txt");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        three(folder.path());
        refused("thesis.txt");
        refused("000007.torch");
        Checksums::open(folder.path(), "chunks").unwrap();
    }

    #[test]
    fn folder_without_scenes_accepts_other_options() {
        let folder = tempfile::tempdir().unwrap();
        let mut checksums = Checksums::open(folder.path(), "chunks").unwrap();
        checksums.begin().unwrap();
        checksums.write("skipped.json", b"all of them").unwrap();
        Checksums::open(folder.path(), "scenes").unwrap().begin().unwrap();
        assert!(std::fs::read_to_string(folder.path().join(FILE_NAME)).unwrap().starts_with("# made as: scenes\n"));
    }

    #[test]
    fn refused_folder_keeps_nested_files() {
        let folder = tempfile::tempdir().unwrap();
        let mine = [".clift-x1", "mine/.clift-y2", ".clift-z3/notes.txt"].map(|name| folder.path().join(name));
        for path in &mine {
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, "x").unwrap();
        }
        let message = Checksums::open(folder.path(), "chunks").unwrap_err().to_string();
        assert!(message.contains("it holds mine, which is not listed"), "{message}");
        assert!(mine.iter().all(|path| path.exists()));
        std::fs::rename(folder.path().join("mine"), folder.path().join(".clift-w4")).unwrap();
        three(folder.path());
        assert!(!mine[0].exists() && mine[2].exists() && folder.path().join(".clift-w4/.clift-y2").exists());
    }

    #[test]
    fn checksums_of_other_programs_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let sums = format!("{}  notes.txt\n", hex::encode(Sha256::digest(b"first")));
        std::fs::write(at("notes.txt"), "second").unwrap();
        for (text, expected) in [
            (sums.clone(), "the SHA256SUMS is not from a conversion"),
            (format!("{MADE_AS}chunks\n{sums}"), "the checksum of notes.txt differs from SHA256SUMS"),
        ] {
            std::fs::write(at(FILE_NAME), &text).unwrap();
            let message =
                Checksums::open(folder.path(), "chunks").and_then(|mut checksums| checksums.begin()).unwrap_err();
            assert!(message.to_string().contains(expected), "{message}");
            assert_eq!(std::fs::read_to_string(at("notes.txt")).unwrap(), "second");
            assert_eq!(std::fs::read_to_string(at(FILE_NAME)).unwrap(), text);
        }
    }
}
