//! The contact sheets of an evaluation on disk.

use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use clift_core::{StagedDir, derive_seed};

use crate::error::EvalError;
use crate::figures::canvas::Canvas;

/// The contact sheets of an evaluation, which replace the sheets of an earlier evaluation in the same folder.
pub(crate) struct Sheets {
    folder: PathBuf,
    files: StagedDir,
    former: BTreeSet<String>,
}

impl Sheets {
    pub fn new(evaluation: &Path) -> Result<Self, EvalError> {
        let folder = evaluation.join("sheets");
        let files = StagedDir::new(&folder).map_err(EvalError::io("making a folder", &folder))?;
        // The earlier scenes.csv lists the earlier scenes. Other files in the folder belong to the user.
        let table = csv::Reader::from_path(evaluation.join("scenes.csv"));
        let rows = table.into_iter().flat_map(|table| table.into_records().map_while(Result::ok));
        Ok(Self { folder, files, former: rows.map(|row| sheet_name(&row[0])).collect() })
    }

    pub fn add(&self, sheet: &Canvas, key: &str) -> Result<(), EvalError> {
        sheet.write_png(&self.files.path().join(sheet_name(key)))
    }

    /// Renames all sheets to their final names and removes the earlier sheets.
    pub fn keep(self) -> Result<(), EvalError> {
        let Self { folder, files, former } = self;
        let replace = || {
            let kept = files.commit()?;
            for name in former.iter().filter(|name| !kept.contains(OsStr::new(name))) {
                match std::fs::remove_file(folder.join(name)) {
                    Err(error) if error.kind() != ErrorKind::NotFound => return Err(error),
                    _ => {}
                }
            }
            Ok(())
        };
        replace().map_err(EvalError::io("writing the sheets", &folder))
    }
}

/// Largest number of characters of a scene key in a file name. File systems allow 255 bytes, with the ending.
const MAX_KEY_CHARS: usize = 120;

/// Returns a scene key as a file name: every character except letters, digits, `-`, `_` and `.` becomes `_`, and a
/// leading dot does too. Of a longer key the name has the first 120 characters, `-` and a hash of the key as 16 hexadecimal
/// digits.
pub fn file_name(key: &str) -> String {
    let name = key.chars().map(|c| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '_' });
    let name: String = name.enumerate().map(|(i, c)| if i == 0 && c == '.' { '_' } else { c }).collect();
    if name.len() <= MAX_KEY_CHARS { name } else { format!("{}-{:016x}", &name[..MAX_KEY_CHARS], derive_seed(0, key)) }
}

/// Returns the file name of the sheet of a scene: [`file_name`], with a hash of the key if that is another text, so that the
/// files of `a/b` and `a_b` differ.
fn sheet_name(key: &str) -> String {
    let name = file_name(key);
    let has_hash = name.len() > MAX_KEY_CHARS;
    if name == key || has_hash { name + ".png" } else { format!("{name}-{:08x}.png", derive_seed(0, key) as u32) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn file_names_stay_in_the_folder_and_are_short_and_distinct() {
        assert_eq!(["..", "../x", "/etc", "a b"].map(file_name), ["_.", "_._x", "_etc", "a_b"]);
        let [a, b] = ["a", "b"].map(|end| file_name(&format!("{}{end}", "room".repeat(1250))));
        assert!(a.len() < 200 && b.len() == a.len() && a != b, "{a} {b}");
        assert_eq!(file_name(&"x".repeat(120)), "x".repeat(120));
        let names = ["a/b", "a_b", "a?b"].map(sheet_name);
        assert!(names[1] == "a_b.png" && names.iter().collect::<BTreeSet<_>>().len() == 3, "{names:?}");
    }
}
