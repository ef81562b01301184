//! The data that an existing run was trained on, as its `config.toml` has it.

use std::path::{Path, PathBuf};

use crate::config::config::Config;
use crate::error::TrainError;

/// Data keys in the `config.toml` of a run.
pub(crate) struct TrainingData {
    root: Option<PathBuf>,
    /// The `data.hold_out` that the run was trained with: 0 for a run from before the key.
    pub hold_out: usize,
    /// Whether the file has `data.hold_out`.
    pub has_key: bool,
}

impl TrainingData {
    /// Reads the keys of the run in `folder`.
    ///
    /// # Errors
    /// [`TrainError::Io`] and [`TrainError::BadFile`].
    pub fn read(folder: &Path) -> Result<Self, TrainError> {
        let path = folder.join("config.toml");
        let text = std::fs::read_to_string(&path).map_err(TrainError::io("reading the run's config", &path))?;
        let table: toml::Table = text.parse().map_err(TrainError::bad_file("config", &path))?;
        let key = |name: &str| table.get("data").and_then(|data| data.get(name));
        let hold_out = key("hold_out").and_then(toml::Value::as_integer);
        Ok(Self {
            root: key("root").and_then(toml::Value::as_str).map(PathBuf::from),
            hold_out: hold_out.and_then(|every| usize::try_from(every).ok()).unwrap_or_default(),
            has_key: hold_out.is_some(),
        })
    }

    /// Returns whether `config` reads the data set that the run was trained on.
    pub fn is_of(&self, config: &Config) -> bool {
        let real = |path: &PathBuf| path.canonicalize().unwrap_or_else(|_| path.clone());
        self.root.as_ref().map(real) == config.data.root.as_ref().map(real)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_before_the_key_held_out_no_frame() {
        let folder = tempfile::tempdir().unwrap();
        let read = |text: &str| {
            std::fs::write(folder.path().join("config.toml"), text).unwrap();
            TrainingData::read(folder.path()).unwrap()
        };
        assert_eq!(read("[data]\nwidth = 8").hold_out, 0);
        let root = folder.path().display().to_string();
        let data = read(&format!("[data]\nhold_out = 4\nroot = '{root}'"));
        let mut config = Config::default();
        assert!(data.hold_out == 4 && !data.is_of(&config));
        config.data.root = Some(folder.path().join("."));
        assert!(data.is_of(&config), "the same folder by another path");
    }
}
