//! `SHA256SUMS`: which files of a folder are complete, what they hold, and how they were made.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Read, Write};
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use crate::error::DataError;
use crate::files::atomic::{TEMPORARY, replace_file};
use crate::files::listing::has_ending;

/// As `sha256sum` calls it: a line per file, sum and name.
const FILE_NAME: &str = "SHA256SUMS";
/// Starts the line that says how the files are made: a comment to `sha256sum -c`.
const MADE_AS: &str = "# made as: ";
/// Scenes of chunks, by key: the file of each.
pub(crate) const INDEX: &str = "index.json";
/// The [`Ledger`](crate::skip_report::SkipReport) of what is not in the folder.
pub(crate) const SKIPPED: &str = "skipped.json";
/// What is written beside scenes.
const LISTS: [&str; 2] = [INDEX, SKIPPED];

/// The sums of a folder that is being written.
///
/// A file's line is on the disk before the file has its name: what is in the folder without a line is someone else's.
#[derive(Debug)]
pub(crate) struct Checksums {
    folder: PathBuf,
    /// How the files are made, on one line.
    made_as: String,
    sums: BTreeMap<String, String>,
    /// Files with a line that hold something else now.
    damaged: BTreeSet<String>,
}

impl Checksums {
    /// Looks at a folder, new or empty or one that was started, and changes nothing in it. Lines of files that are missing
    /// or hold something else are dropped: they will be written again.
    ///
    /// # Errors
    /// [`DataError::BadIndex`] for a folder with any other file, or whose files were made in another way.
    pub fn open(folder: &Path, made_as: &str) -> Result<Self, DataError> {
        let bad = |what: String| DataError::BadIndex { what, path: folder.to_path_buf() };
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
            // A line that was cut off has no end, and its file no name yet.
            let lines: Vec<&str> = text.split_inclusive('\n').filter_map(|line| line.strip_suffix('\n')).collect();
            found = lines.iter().find_map(|line| line.strip_prefix(MADE_AS)).map(str::to_owned);
            if found.is_none() {
                // It is not one of ours, and neither are the files that it names.
                return Err(bad(format!(
                    "its {FILE_NAME} does not say how the files were made; choose another folder"
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
        // Lists of what there is are written again whatever they say.
        let has_scenes = checksums.sums.keys().chain(&checksums.damaged).any(|name| has_ending(name, "torch"));
        match found {
            Some(found) if found != made_as && has_scenes => Err(bad(format!(
                "its files were made as: {found}; asked for are: {made_as}; give the same options or choose another folder"
            ))),
            _ => Ok(checksums),
        }
    }

    /// Refuses a folder with a file that has no line, or that is about to be removed and that no conversion writes.
    fn refuse_others(&self) -> Result<(), DataError> {
        let folder = &self.folder;
        let bad = |what: String| DataError::BadIndex { what, path: folder.clone() };
        let reading = || DataError::io("reading the folder", folder);
        if let Some(name) =
            self.damaged.iter().find(|name| !has_ending(name, "torch") && !LISTS.contains(&name.as_str()))
        {
            return Err(bad(format!("its {name} is not what {FILE_NAME} says; choose an empty folder")));
        }
        let entries = match std::fs::read_dir(folder) {
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(()),
            entries => entries.map_err(reading())?,
        };
        for entry in entries {
            let name = entry.map_err(reading())?.file_name().to_string_lossy().into_owned();
            let is_ours = name == FILE_NAME || name.starts_with(TEMPORARY);
            if !is_ours && !self.sums.contains_key(&name) && !self.damaged.contains(&name) {
                return Err(bad(format!(
                    "it holds {name}, which is in no line of {FILE_NAME}; choose an empty folder"
                )));
            }
        }
        Ok(())
    }

    /// Makes the folder where it is new, and removes what kills in the middle of writing have left, and files that hold
    /// something else than their line says.
    pub fn begin(&mut self) -> Result<(), DataError> {
        std::fs::create_dir_all(&self.folder).map_err(DataError::io("making the folder", &self.folder))?;
        self.remove_leftovers().map_err(DataError::io("removing what a killed process left", &self.folder))?;
        for name in std::mem::take(&mut self.damaged) {
            self.delete(&name)?;
        }
        self.rewrite()
    }

    /// The files that are complete.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.sums.keys().map(String::as_str)
    }

    /// Writes a file, its line first.
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

    /// Removes the files of these names that have a line.
    pub fn remove_all<'a>(&mut self, names: impl IntoIterator<Item = &'a str>) -> Result<(), DataError> {
        let names: Vec<&str> = names.into_iter().filter(|name| self.sums.contains_key(*name)).collect();
        if names.is_empty() {
            return Ok(());
        }
        for name in names {
            // A kill in between leaves lines without a file, and never a file without a line.
            self.delete(name)?;
            self.sums.remove(name);
        }
        self.rewrite()
    }

    /// Removes the temporary files of this folder, and of no other.
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
        std::fs::remove_file(&path).map_err(DataError::io("removing a file that is to be written again", &path))
    }

    fn rewrite(&self) -> Result<(), DataError> {
        let lines = self.sums.iter().map(|(name, sum)| format!("{sum}  {name}\n"));
        let text: String = std::iter::once(format!("{MADE_AS}{}\n", self.made_as)).chain(lines).collect();
        let path = self.folder.join(FILE_NAME);
        replace_file(&path, text.as_bytes()).map_err(DataError::io("writing the checksums", &path))
    }
}

/// SHA-256 of a file, in hexadecimal.
fn hash_file(path: &Path) -> Result<String, DataError> {
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
    fn the_sum_of_a_file_is_sha_256s() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        std::fs::write(&path, b"abc").unwrap();
        assert_eq!(hash_file(&path).unwrap(), "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
        let mut checksums = Checksums::open(&folder.path().join("out"), "chunks").unwrap();
        checksums.begin().unwrap();
        checksums.write("a", b"abc").unwrap();
        assert_eq!(checksums.sums["a"], hash_file(&path).unwrap());
    }

    /// A folder with the files `a.torch`, `b.torch` and `c.torch`.
    fn three(folder: &Path) {
        let mut checksums = Checksums::open(folder, "chunks").unwrap();
        checksums.begin().unwrap();
        for name in ["a.torch", "b.torch", "c.torch"] {
            checksums.write(name, name.as_bytes()).unwrap();
        }
    }

    #[test]
    fn files_that_changed_and_lines_that_were_cut_are_forgotten() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        three(folder.path());
        std::fs::write(at("a.torch"), "changed").unwrap();
        let text = std::fs::read_to_string(at(FILE_NAME)).unwrap();
        std::fs::write(at(FILE_NAME), format!("{text}18ac3e7343f01689")).unwrap();
        let mut checksums = Checksums::open(folder.path(), "chunks").unwrap();
        assert_eq!(checksums.names().collect::<Vec<_>>(), ["b.torch", "c.torch"]);
        assert!(at("a.torch").exists(), "looking changes nothing");
        checksums.begin().unwrap();
        assert!(!at("a.torch").exists());
        checksums.remove_all(["b.torch", "never.torch"]).unwrap();
        let text = std::fs::read_to_string(at(FILE_NAME)).unwrap();
        assert_eq!(text.lines().count(), 2);
        assert!(text.starts_with("# made as: chunks\n") && text.ends_with("  c.torch\n"), "{text}");
        assert!(!at("b.torch").exists());
    }

    #[test]
    fn a_folder_with_something_else_in_it_is_refused_at_any_time_and_left_as_it_was() {
        let folder = tempfile::tempdir().unwrap();
        let refused = |name: &str| {
            std::fs::write(folder.path().join(name), "").unwrap();
            let message = Checksums::open(folder.path(), "chunks").unwrap_err().to_string();
            std::fs::remove_file(folder.path().join(name)).unwrap();
            assert!(message.contains(&format!("it holds {name}, which is in no line of SHA256SUMS")), "{message}");
        };
        refused("thesis.txt");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        three(folder.path());
        refused("thesis.txt");
        refused("000007.torch");
        Checksums::open(folder.path(), "chunks").unwrap();
    }

    #[test]
    fn files_that_were_made_in_another_way_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        three(folder.path());
        let message = |made_as: &str| Checksums::open(folder.path(), made_as).unwrap_err().to_string();
        let expected = "its files were made as: chunks; asked for are: scenes; give the same options or choose another";
        assert!(message("scenes").contains(expected), "{}", message("scenes"));
        let path = folder.path().join(FILE_NAME);
        let text = std::fs::read_to_string(&path).unwrap();
        std::fs::write(&path, text.trim_start_matches("# made as: chunks\n")).unwrap();
        assert!(message("chunks").contains("does not say how the files were made"), "{}", message("chunks"));
    }

    #[test]
    fn a_folder_without_scenes_may_be_made_in_another_way() {
        let folder = tempfile::tempdir().unwrap();
        let mut checksums = Checksums::open(folder.path(), "chunks").unwrap();
        checksums.begin().unwrap();
        checksums.write("skipped.json", b"all of them").unwrap();
        Checksums::open(folder.path(), "scenes").unwrap().begin().unwrap();
        assert!(std::fs::read_to_string(folder.path().join(FILE_NAME)).unwrap().starts_with("# made as: scenes\n"));
    }

    #[test]
    fn what_a_kill_leaves_is_removed_and_blocks_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let leftover = folder.path().join(".clift-Ab12Cd");
        std::fs::write(&leftover, "half a file").unwrap();
        three(folder.path());
        assert!(!leftover.exists());
        std::fs::write(&leftover, "half a file").unwrap();
        // Killed between the line and the file.
        let path = folder.path().join(FILE_NAME);
        let text = std::fs::read_to_string(&path).unwrap();
        std::fs::write(&path, format!("{text}{}  d\n", hex::encode(Sha256::digest(b"d")))).unwrap();
        let mut checksums = Checksums::open(folder.path(), "chunks").unwrap();
        assert_eq!(checksums.names().collect::<Vec<_>>(), ["a.torch", "b.torch", "c.torch"]);
        checksums.begin().unwrap();
        assert!(!leftover.exists());
    }

    #[test]
    fn a_folder_that_is_refused_keeps_everything_at_any_depth() {
        let folder = tempfile::tempdir().unwrap();
        let mine = [".clift-x1", "mine/.clift-y2", ".clift-z3/notes.txt"].map(|name| folder.path().join(name));
        for path in &mine {
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, "x").unwrap();
        }
        let message = Checksums::open(folder.path(), "chunks").unwrap_err().to_string();
        assert!(message.contains("it holds mine, which is in no line"), "{message}");
        assert!(mine.iter().all(|path| path.exists()));
        std::fs::rename(folder.path().join("mine"), folder.path().join(".clift-w4")).unwrap();
        three(folder.path());
        assert!(!mine[0].exists() && mine[2].exists() && folder.path().join(".clift-w4/.clift-y2").exists());
    }

    #[test]
    fn files_of_someone_elses_checksums_are_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let sums = format!("{}  notes.txt\n", hex::encode(Sha256::digest(b"first")));
        std::fs::write(at("notes.txt"), "second").unwrap();
        for (text, expected) in [
            (sums.clone(), "does not say how the files were made"),
            (format!("{MADE_AS}chunks\n{sums}"), "its notes.txt is not what SHA256SUMS says"),
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
