//! Which folders hold a scene: cameras in a known form, next to pictures.

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use crate::colmap::{find_model, read_colmap};
use crate::error::DataError;
use crate::photo::PhotoScene;
use crate::picture_folder::{file_names, has_ending, numbered_pictures};
use crate::re10k_text::{looks_like_re10k, read_re10k_text};
use crate::transforms::{PhotoOptions, read_transforms};

/// How far below the root scenes are looked for: DL3DV has them two folders down.
const MAX_DEPTH: usize = 3;
/// Most folders that are looked at.
const MAX_FOLDERS: usize = 200_000;
/// Digits of the hashes that DL3DV's scenes are named after.
const HASH_LENGTH: usize = 64;

/// The cameras of one scene.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum SceneFiles {
    /// A `transforms.json`.
    Transforms(PathBuf),
    /// A COLMAP model, and the folder of its scene.
    Colmap { folder: PathBuf, model: PathBuf },
    /// A text file of RealEstate10K, and the folder of its frames.
    Re10kText { cameras: PathBuf, frames: PathBuf },
}

/// A scene on disk that has not been read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct SceneFolder {
    pub key: String,
    pub files: SceneFiles,
}

impl SceneFolder {
    /// Reads the cameras and finds their pictures.
    pub fn read(&self, options: &PhotoOptions) -> Result<PhotoScene, DataError> {
        match &self.files {
            SceneFiles::Transforms(path) => read_transforms(path, options),
            SceneFiles::Colmap { folder, model } => read_colmap(folder, model, options),
            SceneFiles::Re10kText { cameras, frames } => read_re10k_text(cameras, frames),
        }
    }

    /// The file or folder that the cameras are in.
    pub fn path(&self) -> &Path {
        match &self.files {
            SceneFiles::Transforms(path) | SceneFiles::Colmap { model: path, .. } => path,
            SceneFiles::Re10kText { cameras, .. } => cameras,
        }
    }

    /// Whether this is a scene of DL3DV: a `transforms.json` in a folder named after a hash.
    pub fn is_dl3dv(&self) -> bool {
        let name = self.key.rsplit('/').next().unwrap_or_default();
        let is_hash = name.len() == HASH_LENGTH && name.bytes().all(|byte| byte.is_ascii_hexdigit());
        is_hash && matches!(self.files, SceneFiles::Transforms(_))
    }

    /// A file that is a scene by itself, named after its folder.
    pub fn of_file(path: &Path) -> Self {
        let absolute = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        Self { key: name_of(absolute.parent().unwrap_or(path)), files: SceneFiles::Transforms(path.to_owned()) }
    }
}

/// The scene that a folder is, if it is one.
pub(crate) fn scene_in(folder: &Path) -> Option<SceneFiles> {
    // DL3DV's benchmark has each scene once more, as COLMAP's model below gaussian_splat/.
    let transforms = ["transforms.json", "nerfstudio/transforms.json"].map(|name| folder.join(name));
    if let Some(path) = transforms.into_iter().find(|path| path.is_file()) {
        return Some(SceneFiles::Transforms(path));
    }
    if let Some(model) = find_model(folder) {
        return Some(SceneFiles::Colmap { folder: folder.to_owned(), model });
    }
    re10k_in(folder)
}

/// A clip of RealEstate10K in a folder of its own: its cameras as the only text file, frames beside it or one below.
fn re10k_in(folder: &Path) -> Option<SceneFiles> {
    let names = file_names(folder).ok()?;
    let mut texts = names.iter().filter(|name| has_ending(name, "txt"));
    let (Some(text), None) = (texts.next(), texts.next()) else { return None };
    let cameras = folder.join(text);
    if !looks_like_re10k(&cameras) {
        return None;
    }
    let below = names.iter().map(|name| folder.join(name)).filter(|path| path.is_dir());
    let mut folders = std::iter::once(folder.to_owned()).chain(below);
    let frames = folders.find(|frames| numbered_pictures(frames).is_ok_and(|pictures| !pictures.is_empty()))?;
    Some(SceneFiles::Re10kText { cameras, frames })
}

/// Finds the scenes in `base` and below it, sorted by key. A key is the name of the scene's folder, or the way to it
/// where several have that name.
///
/// # Errors
/// [`DataError::Io`] for a `base` that cannot be listed, and [`DataError::UnknownLayout`] for too many folders.
pub(crate) fn find_scenes(base: &Path) -> Result<Vec<SceneFolder>, DataError> {
    if let Some(files) = scene_in(base) {
        let absolute = base.canonicalize().unwrap_or_else(|_| base.to_owned());
        return Ok(vec![SceneFolder { key: name_of(&absolute), files }]);
    }
    let mut found: Vec<(PathBuf, SceneFiles)> = Vec::new();
    let mut seen = HashSet::new();
    let mut level = vec![PathBuf::new()];
    file_names(base)?;
    for _ in 0..MAX_DEPTH {
        let mut next = Vec::new();
        for inside in level {
            for name in file_names(&base.join(&inside)).unwrap_or_default() {
                let (inside, path) = (inside.join(&name), base.join(&inside).join(&name));
                // A link may lead back up, or to a scene that has been found.
                let mut is_new = |path: &Path| path.canonicalize().is_ok_and(|path| seen.insert(path));
                if name.starts_with('.') || !path.is_dir() || !is_new(&path) {
                    continue;
                }
                if seen.len() > MAX_FOLDERS {
                    let what = format!("more than {MAX_FOLDERS} folders; give the folder of the scenes themselves");
                    return Err(DataError::UnknownLayout { what, path: base.to_owned() });
                }
                match scene_in(&path) {
                    Some(files) => found.push((inside, files)),
                    None => next.push(inside),
                }
            }
        }
        level = next;
    }
    let mut names = HashSet::new();
    let shared: HashSet<String> =
        found.iter().map(|(way, _)| name_of(way)).filter(|name| !names.insert(name.clone())).collect();
    let key = |way: &Path| match name_of(way) {
        name if shared.contains(&name) => way.to_string_lossy().replace('\\', "/"),
        name => name,
    };
    let mut scenes: Vec<_> = found.into_iter().map(|(way, files)| SceneFolder { key: key(&way), files }).collect();
    scenes.sort_by(|a, b| a.key.cmp(&b.key));
    Ok(scenes)
}

fn name_of(folder: &Path) -> String {
    folder.file_name().map_or_else(|| "scene".into(), |name| name.to_string_lossy().into_owned())
}
