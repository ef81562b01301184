//! The contact sheets of an evaluation on disk.

use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use clift_core::StagedDir;

use crate::error::EvalError;
use crate::figures::canvas::Canvas;
use crate::sweep::predictions::distinct_file_name;

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

fn sheet_name(key: &str) -> String {
    format!("{}.png", distinct_file_name(key))
}
