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

    /// Returns whether `config` may read frames that the run was trained on: from the same folder, from one inside the other,
    /// or, where the folder of the training is gone, from any, because the data may have moved.
    pub fn is_of(&self, config: &Config) -> bool {
        let (Some(trained), Some(read)) = (&self.root, &config.data.root) else { return self.root == config.data.root };
        let Ok(trained) = trained.canonicalize() else { return true };
        read.canonicalize().is_ok_and(|read| read.starts_with(&trained) || trained.starts_with(&read))
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
        let [inner, other] = ["inner", "other"].map(|name| folder.path().join(name));
        std::fs::create_dir(&inner).unwrap();
        config.data.root = Some(inner.clone());
        assert!(data.is_of(&config), "a part of it");
        let data = read(&format!("[data]\nroot = '{}'", inner.display()));
        config.data.root = Some(other.clone());
        std::fs::create_dir(&other).unwrap();
        assert!(!data.is_of(&config));
        std::fs::remove_dir(&inner).unwrap();
        assert!(data.is_of(&config), "it may have moved");
    }
}
