//! Finding the folders that hold a scene: cameras in a known format, with images.

use std::collections::{HashMap, HashSet, VecDeque};
use std::path::{Path, PathBuf};

use clift_core::folder_of;

use crate::error::DataError;
use crate::files::listing::{file_names, has_ending};
use crate::sources::keys::{is_dl3dv_key, last_name};
use crate::sources::photos::colmap::reader::{find_model, read_colmap};
use crate::sources::photos::nerfstudio::read_transforms;
use crate::sources::photos::photo::{PhotoOptions, PhotoScene};
use crate::sources::photos::re10k_text::read_re10k_text;

/// Depth of the search below the root; scenes of DL3DV lie two folders down.
const MAX_DEPTH: usize = 3;
const MAX_FOLDERS: usize = 200_000;

/// Camera files of a scene: a `transforms.json`, a COLMAP model, or a text file of RealEstate10K.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum SceneFiles {
    Transforms(PathBuf),
    Colmap { folder: PathBuf, model: PathBuf },
    Re10kText { cameras: PathBuf, frames: PathBuf },
}

/// An unread scene on disk.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct SceneFolder {
    pub key: String,
    pub files: SceneFiles,
}

impl SceneFolder {
    pub fn read(&self, options: &PhotoOptions) -> Result<PhotoScene, DataError> {
        let (mut scene, folder) = match &self.files {
            SceneFiles::Transforms(path) => (read_transforms(path, options)?, folder_of(path)),
            SceneFiles::Colmap { folder, model } => (read_colmap(folder, model, options)?, folder.as_path()),
            SceneFiles::Re10kText { cameras, frames } => return read_re10k_text(cameras, frames),
        };
        scene.find_masks(folder);
        scene.photos.iter_mut().for_each(|photo| photo.poses_from = options.poses_from);
        Ok(scene)
    }

    /// Returns what to do about a scene without any image.
    pub fn image_hint(&self) -> &'static str {
        match self.files {
            SceneFiles::Re10kText { .. } => {
                "name frames by time stamp, such as 52553000.png, or extract one for every line of the cameras; \
                 data.files.frames names another folder of frames"
            }
            _ => "data.files.image_folder names another folder of images",
        }
    }

    pub fn path(&self) -> &Path {
        match &self.files {
            SceneFiles::Transforms(path) | SceneFiles::Colmap { model: path, .. } => path,
            SceneFiles::Re10kText { cameras, .. } => cameras,
        }
    }

    /// Returns whether this is a DL3DV scene: a `transforms.json` in a folder named by hash.
    pub fn is_dl3dv(&self) -> bool {
        is_dl3dv_key(&self.key) && matches!(self.files, SceneFiles::Transforms(_))
    }

    /// Creates a scene of a single camera file, named by its folder.
    pub fn of_file(path: &Path) -> Self {
        let absolute = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        Self { key: name_of(absolute.parent().unwrap_or(path)), files: SceneFiles::Transforms(path.to_owned()) }
    }
}

/// Returns the scene that lies directly in a folder.
pub(crate) fn scene_in(folder: &Path) -> Option<SceneFiles> {
    // First, because the DL3DV benchmark also holds a COLMAP model of every scene, below gaussian_splat/.
    let transforms = ["transforms.json", "nerfstudio/transforms.json"].map(|name| folder.join(name));
    if let Some(path) = transforms.into_iter().find(|path| path.is_file()) {
        return Some(SceneFiles::Transforms(path));
    }
    find_model(folder).map(|model| SceneFiles::Colmap { folder: folder.to_owned(), model })
}

/// Finds the scenes in `base` and below it, sorted by key: the name of the scene folder, or its path if several folders have
/// that name. Of a folder that is reachable by several paths, the first counts.
///
/// Returns the paths of folders without cameras, too: DL3DV scenes by their names, and folders with a folder of images.
pub(crate) fn find_scenes(base: &Path) -> Result<(Vec<SceneFolder>, Vec<String>), DataError> {
    if let Some(files) = scene_in(base) {
        let absolute = base.canonicalize().unwrap_or_else(|_| base.to_owned());
        return Ok((vec![SceneFolder { key: name_of(&absolute), files }], Vec::new()));
    }
    let (mut found, mut without_cameras) = (Vec::<(String, SceneFiles)>::new(), Vec::<String>::new());
    // Visited folders by canonical path: links may lead in circles.
    let mut seen: HashSet<PathBuf> = base.canonicalize().into_iter().collect();
    let mut folders = VecDeque::from(folders_in(base, "")?);
    while let Some(way) = folders.pop_front() {
        let path = base.join(&way);
        if !path.canonicalize().is_ok_and(|real| seen.insert(real)) {
            continue;
        }
        if seen.len() > MAX_FOLDERS {
            let what = format!("more than {MAX_FOLDERS} folders; give the folder of the scenes");
            return Err(DataError::UnknownLayout { what, path: base.to_owned() });
        }
        if let Some(files) = scene_in(&path) {
            found.push((way, files));
            continue;
        }
        let is_below = |above: &String| way.starts_with(&format!("{above}/"));
        if (is_dl3dv_key(&way) || path.join("images").is_dir()) && !without_cameras.iter().any(is_below) {
            without_cameras.push(way.clone());
        }
        if way.split('/').count() < MAX_DEPTH {
            // Folders without read permission are ignored.
            folders.extend(folders_in(&path, &way).unwrap_or_default());
        }
    }
    without_cameras.retain(|way| !found.iter().any(|(scene, _)| scene.starts_with(&format!("{way}/"))));
    let mut counts: HashMap<&str, usize> = HashMap::new();
    for (way, _) in &found {
        *counts.entry(last_name(way)).or_default() += 1;
    }
    let key = |way: &str| if counts[last_name(way)] > 1 { way.to_owned() } else { last_name(way).to_owned() };
    let keys: Vec<String> = found.iter().map(|(way, _)| key(way)).collect();
    let scenes = found.into_iter().zip(keys);
    let mut scenes: Vec<_> = scenes.map(|((_, files), key)| SceneFolder { key, files }).collect();
    scenes.sort_by(|a, b| a.key.cmp(&b.key));
    Ok((scenes, without_cameras))
}

/// Returns the paths of the subfolders of `folder`, in order of their names.
fn folders_in(folder: &Path, way: &str) -> Result<Vec<String>, DataError> {
    let mut names = file_names(folder)?;
    names.retain(|name| folder.join(name).is_dir());
    Ok(names.into_iter().map(|name| if way.is_empty() { name } else { format!("{way}/{name}") }).collect())
}

/// Returns the camera files with other names, such as `transforms_train.json`.
pub(crate) fn transforms_in(folder: &Path) -> Vec<String> {
    let mut names = file_names(folder).unwrap_or_default();
    names.retain(|name| name.starts_with("transforms") && has_ending(name, "json"));
    names
}

fn name_of(folder: &Path) -> String {
    folder.file_name().map_or_else(|| "scene".into(), |name| name.to_string_lossy().into_owned())
}
