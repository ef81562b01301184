//! The data that an existing run was trained on, as its `config.toml` has it.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::config::config::Config;
use crate::error::TrainError;

/// The `[data]` section of a run, as far as it says which frames were trained on.
#[derive(Deserialize)]
pub(crate) struct TrainingData {
    root: Option<PathBuf>,
    pub hold_out: usize,
}

impl TrainingData {
    /// Reads the section of the run in `folder`.
    pub fn read(folder: &Path) -> Result<Self, TrainError> {
        #[derive(Deserialize)]
        struct Sections {
            data: TrainingData,
        }
        let path = folder.join("config.toml");
        let text = std::fs::read_to_string(&path).map_err(TrainError::io("reading the run's config", &path))?;
        let sections: Sections = toml::from_str(&text).map_err(TrainError::bad_file("config", &path))?;
        Ok(sections.data)
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
    fn data_inside_the_folder_of_the_training_is_training_data() {
        let folder = tempfile::tempdir().unwrap();
        let read = |text: &str| {
            std::fs::write(folder.path().join("config.toml"), text).unwrap();
            TrainingData::read(folder.path()).unwrap()
        };
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
        let data = read(&format!("[data]\nhold_out = 0\nroot = '{}'", inner.display()));
        config.data.root = Some(other.clone());
        std::fs::create_dir(&other).unwrap();
        assert!(!data.is_of(&config));
        std::fs::remove_dir(&inner).unwrap();
        assert!(data.is_of(&config), "it may have moved");
    }
}
