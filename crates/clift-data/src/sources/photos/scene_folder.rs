//! Which folders hold a scene: cameras in a known form, next to pictures.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::path::{Path, PathBuf};

use crate::error::DataError;
use crate::files::listing::{file_names, has_ending};
use crate::skip_report::{first_few, plural};
use crate::sources::keys::{is_dl3dv_key, last_name};
use crate::sources::photos::colmap::reader::{find_model, read_colmap};
use crate::sources::photos::image_folder::numbered_pictures;
use crate::sources::photos::nerfstudio::read_transforms;
use crate::sources::photos::photo::{PhotoOptions, PhotoScene};
use crate::sources::photos::re10k_text::{looks_like_re10k, read_re10k_text};

/// How far below the root scenes are looked for: DL3DV has them two folders down.
const MAX_DEPTH: usize = 3;
/// Most folders that are looked at.
const MAX_FOLDERS: usize = 200_000;

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
        is_dl3dv_key(&self.key) && matches!(self.files, SceneFiles::Transforms(_))
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

/// The scenes of a folder, and what else was met.
pub(crate) struct FoundScenes {
    /// Sorted by key. A key is the name of the scene's folder, or the way to it where several have that name.
    pub scenes: Vec<SceneFolder>,
    /// Ways to data of other layouts, with what it is.
    pub others: Vec<String>,
    /// What is to be known of the names.
    pub notes: Vec<String>,
}

/// Finds the scenes in `base` and below it. Of a folder that links lead to, the way without links is used, or the first
/// in order of names.
///
/// # Errors
/// [`DataError::Io`] for a `base` that cannot be listed, and [`DataError::UnknownLayout`] for too many folders.
pub(crate) fn find_scenes(base: &Path) -> Result<FoundScenes, DataError> {
    if let Some(files) = scene_in(base) {
        let absolute = base.canonicalize().unwrap_or_else(|_| base.to_owned());
        let scenes = vec![SceneFolder { key: name_of(&absolute), files }];
        return Ok(FoundScenes { scenes, others: Vec::new(), notes: Vec::new() });
    }
    let mut found: Vec<(String, SceneFiles)> = Vec::new();
    let (mut others, mut again) = (Vec::new(), Vec::new());
    // What each folder is, by its way without links: a scene, by its place in `found`, or none.
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
                again.push(format!("{way} to {first}"));
                continue;
            }
            Some(None) => continue,
            None if seen.len() > MAX_FOLDERS => {
                let what = format!("more than {MAX_FOLDERS} folders; give the folder of the scenes themselves");
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
        }
        if way.split('/').count() < MAX_DEPTH {
            // A folder that may not be listed holds nothing for this user.
            push_folders(&path, &way, &mut folders, &mut links).unwrap_or_default();
        }
    }
    let mut notes = Vec::new();
    if !again.is_empty() {
        notes.push(format!("{} to what is used already: {}", plural(again.len(), "link"), first_few(&again)));
    }
    let mut ways: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for (way, _) in &found {
        ways.entry(last_name(way)).or_default().push(way);
    }
    let twice = ways.iter().filter(|(name, ways)| is_dl3dv_key(name) && ways.len() > 1);
    let twice: Vec<String> = twice.map(|(_, ways)| ways.join(" and ")).collect();
    if !twice.is_empty() {
        let note = format!("{} of DL3DV there more than once, all of which are used: ", plural(twice.len(), "scene"));
        notes.push(note + &first_few(&twice));
    }
    let key = |way: &str| if ways[last_name(way)].len() > 1 { way.to_owned() } else { last_name(way).to_owned() };
    let keys: Vec<String> = found.iter().map(|(way, _)| key(way)).collect();
    let scenes = found.into_iter().zip(keys);
    let mut scenes: Vec<_> = scenes.map(|((_, files), key)| SceneFolder { key, files }).collect();
    scenes.sort_by(|a, b| a.key.cmp(&b.key));
    others.sort_unstable();
    Ok(FoundScenes { scenes, others, notes })
}

/// Appends the ways to the folders in `folder`, in order of their names and those that are links apart.
fn push_folders(
    folder: &Path,
    way: &str,
    folders: &mut VecDeque<String>,
    links: &mut VecDeque<String>,
) -> Result<(), DataError> {
    let mut names = file_names(folder)?;
    names.sort_unstable();
    for name in names.into_iter().filter(|name| !name.starts_with('.')) {
        let path = folder.join(&name);
        let to = if path.is_symlink() { &mut *links } else { &mut *folders };
        if path.is_dir() {
            to.push_back(if way.is_empty() { name } else { format!("{way}/{name}") });
        }
    }
    Ok(())
}

/// What a folder without a scene of photos holds instead, if it is data that would have to be opened by itself.
fn other_data_in(folder: &Path) -> Option<String> {
    let names = file_names(folder).ok()?;
    if names.iter().any(|name| has_ending(name, "torch")) {
        return Some("chunks or scenes in .torch files".into());
    }
    let mut texts = names.iter().filter(|name| has_ending(name, "txt")).take(8);
    if texts.any(|name| looks_like_re10k(&folder.join(name))) {
        return Some("RealEstate10K's text files".into());
    }
    transforms_in(folder).into_iter().next()
}

/// Files of cameras with names of their own, such as `transforms_train.json`.
pub(crate) fn transforms_in(folder: &Path) -> Vec<String> {
    let mut names = file_names(folder).unwrap_or_default();
    names.retain(|name| name.starts_with("transforms") && has_ending(name, "json"));
    names.sort_unstable();
    names
}

fn name_of(folder: &Path) -> String {
    folder.file_name().map_or_else(|| "scene".into(), |name| name.to_string_lossy().into_owned())
}
