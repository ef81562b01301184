//! Images named by a camera file, wherever they are.

use std::path::{Component, Path, PathBuf};

use percent_encoding::percent_decode_str;

use crate::sources::photos::image_folder::ImageFolders;
use crate::sources::photos::photo::{NO_IMAGE, PhotoOptions};

/// Folders of images, and of scaled copies of them.
pub(crate) const IMAGE_FOLDERS: [&str; 4] = ["images", "images_2", "images_4", "images_8"];

/// Largest number of trailing parts of an image path that are searched in the scene folder.
const MAX_SUFFIX_PARTS: usize = 32;

/// Finds the images of a scene folder by the names in its camera file.
pub(crate) struct ImageLocator<'a> {
    folder: &'a Path,
    folders: ImageFolders,
    /// The configured image folder, or a default folder.
    image_folder: Option<PathBuf>,
}

impl<'a> ImageLocator<'a> {
    pub fn new(folder: &'a Path, options: &PhotoOptions) -> Self {
        let mut folders = ImageFolders::default();
        let image_folder = match &options.image_folder {
            Some(name) => Some(folder.join(name)),
            None => default_folder(folder, options, &mut folders),
        };
        Self { folder, folders, image_folder }
    }

    /// Returns the number of images in the searched folders that no name has found.
    pub fn num_unrequested(&self) -> usize {
        self.folders.num_unrequested()
    }

    /// Returns the path of an image, or why there is none. The name may have the separators of another system, be that of
    /// a URL, belong to another computer, or name an image of which only scaled copies exist.
    pub fn find(&mut self, file_path: &str) -> Result<PathBuf, String> {
        first_found(file_path, |name| self.find_at(Path::new(name)))
    }

    fn find_at(&mut self, named: &Path) -> Result<PathBuf, String> {
        if let Some(folder) = self.image_folder.clone() {
            let below =
                if is_absolute(named) { self.longest_suffix(&folder, named) } else { without_first_folder(named) };
            return self.folders.find(&folder.join(below));
        }
        let given = self.folder.join(named);
        let (Some(parent), Some(name)) = (given.parent(), given.file_name()) else {
            return Err(NO_IMAGE.into());
        };
        let is_final = |found: &Result<PathBuf, String>| found.is_ok() || !is_absolute(named);
        if self.folders.has(parent) {
            let found = self.folders.find(&given);
            if is_final(&found) {
                return found;
            }
        }
        // Only scaled images exist, or the path belongs to another folder or computer.
        let suffixes = path_suffixes(named).map(|suffix| self.folder.join(suffix));
        for candidate in std::iter::once(given.clone()).chain(suffixes) {
            let Some(parent) = candidate.parent().filter(|parent| *parent != self.folder) else { continue };
            let last = parent.file_name().unwrap_or_default().to_string_lossy();
            let scaled = ["", "_2", "_4", "_8"].map(|suffix| parent.with_file_name(format!("{last}{suffix}")));
            if let Some(folder) = scaled.into_iter().find(|folder| self.folders.has(folder)) {
                let found = self.folders.find(&folder.join(name));
                if is_final(&found) {
                    return found;
                }
            }
        }
        if !is_absolute(named) {
            return Err(NO_IMAGE.into());
        }
        self.folders.find(&self.folder.join(name)).or_else(|error| {
            let folders = IMAGE_FOLDERS.map(|folder| self.folder.join(folder));
            let folder = folders.into_iter().find(|folder| self.folders.has(folder)).ok_or_else(|| error.clone())?;
            let below = self.longest_suffix(&folder, named);
            self.folders.find(&folder.join(below)).map_err(|_| error)
        })
    }

    /// Returns the longest suffix of a path whose parent exists in `folder`.
    fn longest_suffix(&mut self, folder: &Path, named: &Path) -> PathBuf {
        let mut suffixes = path_suffixes(named);
        let found =
            suffixes.find(|suffix| suffix.parent().is_some_and(|parent| self.folders.has(&folder.join(parent))));
        found.unwrap_or_else(|| named.file_name().unwrap_or_default().into())
    }
}

/// Tries the spellings of a name: as it is, with the separators of Windows (some tools mix both) and with the `%20` of a URL.
///
/// # Errors
/// That of the name as it is.
pub(crate) fn first_found(
    name: &str,
    mut find: impl FnMut(&str) -> Result<PathBuf, String>,
) -> Result<PathBuf, String> {
    find(name).or_else(|error| {
        let decode = |name: &str| percent_decode_str(name).decode_utf8().map(std::borrow::Cow::into_owned).ok();
        let slashes = name.contains('\\').then(|| name.replace('\\', "/"));
        let decoded = name.contains('%').then(|| decode(slashes.as_deref().unwrap_or(name))).flatten();
        [slashes, decoded].into_iter().flatten().find_map(|name| find(&name).ok()).ok_or(error)
    })
}

/// Returns the first default image folder whose images have the smallest size, or else the first that exists.
fn default_folder(folder: &Path, options: &PhotoOptions, folders: &mut ImageFolders) -> Option<PathBuf> {
    let mut existing: Vec<PathBuf> = options.first_folders.iter().map(|name| folder.join(name)).collect();
    existing.retain(|folder| folders.has(folder));
    let large = existing.iter().position(|folder| folders.is_at_least(folder, options.min_size));
    (!existing.is_empty()).then(|| existing.swap_remove(large.unwrap_or_default()))
}

/// Returns the suffixes of a path, from the longest (at most [`MAX_SUFFIX_PARTS`] parts) to the file name.
pub(crate) fn path_suffixes(path: &Path) -> impl Iterator<Item = PathBuf> {
    let parts: Vec<_> = path.components().filter(|part| matches!(part, Component::Normal(_))).collect();
    (parts.len().saturating_sub(MAX_SUFFIX_PARTS)..parts.len()).map(move |start| parts[start..].iter().collect())
}

/// Returns whether a path is absolute, on Windows or on other systems.
pub(crate) fn is_absolute(path: &Path) -> bool {
    let first = path.components().next().map(|part| part.as_os_str().to_string_lossy());
    path.has_root() || first.is_some_and(|first| first.len() == 2 && first.ends_with(':'))
}

/// Returns a path without its first folder: `left/1.png` for `images/left/1.png`.
fn without_first_folder(path: &Path) -> PathBuf {
    let parts: Vec<_> = path.components().filter(|part| matches!(part, Component::Normal(_))).collect();
    parts[parts.len().min(2).saturating_sub(1)..].iter().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_paths_give_bounded_suffixes() {
        let suffixes = |path: &str| path_suffixes(Path::new(path)).collect::<Vec<_>>();
        assert_eq!(suffixes("/a/./b/c.png"), ["a/b/c.png", "b/c.png", "c.png"].map(PathBuf::from));
        let deep = suffixes(&"a/".repeat(2000));
        assert_eq!((deep.len(), deep[0].components().count()), (MAX_SUFFIX_PARTS, MAX_SUFFIX_PARTS));
    }
}
