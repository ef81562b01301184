//! The path of a scene's model, which holds after scene and model are moved together.

use std::path::{Component, Path, PathBuf};

use clift_core::folder_of;
use clift_model::SHIPPED_MODEL;

use crate::scene::scene::Scene;

impl Scene {
    /// Returns the `model_path` of a scene file at `file`: relative to the folder of the file for a relative `model`, so that
    /// both can be moved together and read from any folder; an absolute `model` as it is.
    pub fn model_path_for(model: &Path, file: &Path) -> String {
        let relative = || {
            let from = folder_of(file).canonicalize().ok()?;
            let to = model.canonicalize().ok()?;
            let shared = from.components().zip(to.components()).take_while(|(a, b)| a == b).count();
            let up = from.components().skip(shared).map(|_| Component::ParentDir);
            let path: PathBuf = up.chain(to.components().skip(shared)).collect();
            Some(path)
        };
        let path = if model.is_absolute() { None } else { relative() };
        path.unwrap_or_else(|| model.into()).to_string_lossy().into_owned()
    }

    /// Returns the path of the model of the scene that was read from `file`. A relative model path starts at the folder of
    /// the file. The path need not exist. A missing `models/rooms` is the [shipped model](clift_model::find_shipped).
    pub fn find_model(&self, file: &Path) -> PathBuf {
        find_model(&self.model_path, file)
    }
}

pub(crate) fn find_model(model_path: &str, file: &Path) -> PathBuf {
    let path = folder_of(file).join(model_path);
    // The scene may come from a machine that has the repository.
    if path.ends_with(SHIPPED_MODEL) && !path.exists() { SHIPPED_MODEL.into() } else { path }
}
