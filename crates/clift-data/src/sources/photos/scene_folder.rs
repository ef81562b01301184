//! Finding the folders that hold a scene: cameras in a known format, with images.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::path::{Path, PathBuf};

use clift_core::folder_of;

use crate::error::DataError;
use crate::files::listing::{file_names, has_ending};
use crate::skip_report::{first_few, plural};
use crate::sources::keys::{is_dl3dv_key, last_name};
use crate::sources::photos::colmap::reader::{find_model, read_colmap};
use crate::sources::photos::image_folder::images_in;
use crate::sources::photos::nerfstudio::read_transforms;
use crate::sources::photos::photo::{PhotoOptions, PhotoScene};
use crate::sources::photos::re10k_text::{looks_like_re10k, read_re10k_text};

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

impl SceneFiles {
    /// Whether a folder with these files is a capture of its own, whatever its name; clips lie in folders of a data set.
    pub fn is_capture(&self) -> bool {
        !matches!(self, Self::Re10kText { .. })
    }
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
    if let Some(model) = find_model(folder) {
        return Some(SceneFiles::Colmap { folder: folder.to_owned(), model });
    }
    re10k_in(folder)
}

/// Returns the RealEstate10K clip in a folder: cameras in the only text file, frames beside it or one folder below.
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
    let frames = folders.find(|frames| images_in(frames).is_ok_and(|images| !images.is_empty()))?;
    Some(SceneFiles::Re10kText { cameras, frames })
}

#[derive(Default)]
pub(crate) struct FoundScenes {
    /// Scenes sorted by key: the name of the scene folder, or its path if several folders have that name.
    pub scenes: Vec<SceneFolder>,
    /// Paths of data in other layouts, with a description.
    pub others: Vec<String>,
    /// Notes on links and duplicates.
    pub notes: Vec<String>,
    /// Keys of scene folders without cameras: DL3DV scenes by their names, and folders with a folder of images.
    pub without_cameras: Vec<String>,
}

/// Finds the scenes in `base` and below it. A folder that is reachable by several paths has the path without links, or
/// the first one in order of names.
pub(crate) fn find_scenes(base: &Path) -> Result<FoundScenes, DataError> {
    if let Some(files) = scene_in(base) {
        let absolute = base.canonicalize().unwrap_or_else(|_| base.to_owned());
        let scenes = vec![SceneFolder { key: name_of(&absolute), files }];
        return Ok(FoundScenes { scenes, ..FoundScenes::default() });
    }
    let mut found: Vec<(String, SceneFiles)> = Vec::new();
    let (mut others, mut duplicates, mut without_cameras) = (Vec::new(), Vec::new(), Vec::new());
    // Visited folders by canonical path, with the index in `found` if the folder is a scene.
    let mut seen: HashMap<PathBuf, Option<usize>> = HashMap::new();
    seen.extend(base.canonicalize().map(|base| (base, None)));
    let (mut folders, mut links) = (VecDeque::new(), VecDeque::new());
    push_folders(base, "", &mut folders, &mut links)?;
    while let Some(way) = folders.pop_front().or_else(|| links.pop_front()) {
        let path = base.join(&way);
        let Ok(real) = path.canonicalize() else { continue };
        match seen.get(&real) {
            Some(Some(scene)) => {
                let (first, _): &(String, _) = &found[*scene];
                duplicates.push(format!("{way} to {first}"));
                continue;
            }
            Some(None) => continue,
            None if seen.len() > MAX_FOLDERS => {
                let what = format!("more than {MAX_FOLDERS} folders; give the folder of the scenes");
                return Err(DataError::UnknownLayout { what, path: base.to_owned() });
            }
            None => {}
        }
        let files = scene_in(&path);
        seen.insert(real, files.is_some().then_some(found.len()));
        if let Some(files) = files {
            found.push((way, files));
            continue;
        }
        if let Some(kind) = other_data_in(&path) {
            others.push(format!("{way} ({kind})"));
        } else if (is_dl3dv_key(&way) || path.join("images").is_dir())
            && !without_cameras.iter().any(|above| way.starts_with(&format!("{above}/")))
        {
            without_cameras.push(way.clone());
        }
        if way.split('/').count() < MAX_DEPTH {
            // Folders without read permission are ignored.
            push_folders(&path, &way, &mut folders, &mut links).unwrap_or_default();
        }
    }
    without_cameras.retain(|way| !found.iter().any(|(scene, _)| scene.starts_with(&format!("{way}/"))));
    let mut notes = Vec::new();
    if !duplicates.is_empty() {
        let links = plural(duplicates.len(), "link");
        notes.push(format!("{links} to scenes that are used already: {}", first_few(&duplicates)));
    }
    let mut paths: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for (way, _) in &found {
        paths.entry(last_name(way)).or_default().push(way);
    }
    let twice = paths.iter().filter(|(name, paths)| is_dl3dv_key(name) && paths.len() > 1);
    let twice: Vec<String> = twice.map(|(_, paths)| paths.join(" and ")).collect();
    if !twice.is_empty() {
        let note = format!("{} of DL3DV with several copies, all of which are used: ", plural(twice.len(), "scene"));
        notes.push(note + &first_few(&twice));
    }
    let key = |way: &str| if paths[last_name(way)].len() > 1 { way.to_owned() } else { last_name(way).to_owned() };
    let keys: Vec<String> = found.iter().map(|(way, _)| key(way)).collect();
    let scenes = found.into_iter().zip(keys);
    let mut scenes: Vec<_> = scenes.map(|((_, files), key)| SceneFolder { key, files }).collect();
    scenes.sort_by(|a, b| a.key.cmp(&b.key));
    others.sort_unstable();
    Ok(FoundScenes { scenes, others, notes, without_cameras })
}

/// Appends the paths of the subfolders of `folder`, in order of their names, links separately.
fn push_folders(
    folder: &Path,
    way: &str,
    folders: &mut VecDeque<String>,
    links: &mut VecDeque<String>,
) -> Result<(), DataError> {
    for name in file_names(folder)?.into_iter().filter(|name| !name.starts_with('.')) {
        let path = folder.join(&name);
        let to = if path.is_symlink() { &mut *links } else { &mut *folders };
        if path.is_dir() {
            to.push_back(if way.is_empty() { name } else { format!("{way}/{name}") });
        }
    }
    Ok(())
}

fn other_data_in(folder: &Path) -> Option<String> {
    let names = file_names(folder).ok()?;
    if names.iter().any(|name| has_ending(name, "torch")) {
        return Some("chunks or scenes in .torch files".into());
    }
    let mut texts = names.iter().filter(|name| has_ending(name, "txt")).take(8);
    if texts.any(|name| looks_like_re10k(&folder.join(name))) {
        return Some("text files of RealEstate10K".into());
    }
    transforms_in(folder).into_iter().next()
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
