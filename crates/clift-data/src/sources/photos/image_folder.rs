//! Look-up of image files by name.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::ffi::OsString;
use std::path::{Component, Path, PathBuf};

use crate::error::DataError;
use crate::files::listing::{composed, decode_name, file_names, natural_order, raw_file_names};
use crate::image::codec::read_header;
use crate::sources::photos::photo::NO_IMAGE;

/// Extensions of the formats that can be decoded.
const EXTENSIONS: [&str; 3] = ["png", "jpg", "jpeg"];
/// Extensions of image formats that cannot be decoded.
const OTHER_EXTENSIONS: [&str; 8] = ["heic", "webp", "tif", "tiff", "exr", "bmp", "gif", "avif"];

/// Image files of folders. Every folder is listed once.
#[derive(Default)]
pub(crate) struct ImageFolders {
    folders: HashMap<PathBuf, Option<ImageFolder>>,
}

struct ImageFolder {
    path: PathBuf,
    /// Images by composed stem: decoded names, and names as stored.
    by_stem: HashMap<String, Vec<(String, OsString)>>,
    /// Composed stems of files of other formats.
    unreadable: HashSet<String>,
    /// Requested stems with an image.
    requested: HashSet<String>,
}

impl ImageFolders {
    /// Finds an image by its path: the file of that name, or the only file of that stem. Names are compared as bytes, then
    /// decoded and composed.
    ///
    /// # Errors
    /// A reason for the skip report.
    pub fn find(&mut self, path: &Path) -> Result<PathBuf, String> {
        let missing = || NO_IMAGE.to_owned();
        let (Some(parent), Some(name)) = (path.parent(), path.file_name()) else {
            return Err(missing());
        };
        let folder = self.folder(parent).ok_or_else(missing)?;
        let name = decode_name(name.as_encoded_bytes());
        let composed_name = composed(&name);
        let (stem, _) = split_name(&composed_name);
        // A name without an extension may contain a dot: `frame.0001`.
        let named = [&*composed_name, stem].into_iter().find(|stem| folder.by_stem.contains_key(*stem));
        folder.requested.extend(named.map(str::to_owned));
        let names = named.and_then(|stem| folder.by_stem.get(stem));
        match names.map(Vec::as_slice) {
            Some([(_, only)]) => Ok(folder.path.join(only)),
            Some(names) => {
                let same = names.iter().find(|(other, _)| *other == name);
                let same = same.or_else(|| names.iter().find(|(other, _)| composed(other) == composed_name));
                same.map(|(_, name)| folder.path.join(name))
                    .ok_or_else(|| "with several images of different extensions".into())
            }
            None if folder.unreadable.contains(stem) => Err("whose image is neither JPEG nor PNG".into()),
            None => Err(missing()),
        }
    }

    /// Returns the number of images that were not requested, in folders with a requested image.
    pub fn num_unrequested(&self) -> usize {
        let folders = self.folders.values().flatten().filter(|folder| !folder.requested.is_empty());
        folders.map(|folder| folder.by_stem.len() - folder.requested.len()).sum()
    }

    pub fn has(&mut self, folder: &Path) -> bool {
        self.folder(folder).is_some()
    }

    /// Returns whether the first image of a folder has at least these columns and rows; false for a folder without images.
    pub fn is_at_least(&mut self, folder: &Path, [width, height]: [usize; 2]) -> bool {
        let names = self.folder(folder).into_iter().flat_map(|folder| folder.by_stem.values().flatten());
        let first = names.map(|(_, name)| name).min().map(|name| folder.join(name));
        let size = first.and_then(|path| read_header(&path).ok()).map(|(size, _)| size);
        size.is_some_and(|[columns, rows]| columns >= width && rows >= height)
    }

    fn folder(&mut self, folder: &Path) -> Option<&mut ImageFolder> {
        let entry = self.folders.entry(folder.to_owned());
        let read = |folder: &Path| ImageFolder::read(folder).ok();
        entry.or_insert_with_key(|folder| read(folder).or_else(|| read(&stored_folder(folder)?))).as_mut()
    }
}

/// Returns the folder whose path has the same characters, composed or not.
fn stored_folder(folder: &Path) -> Option<PathBuf> {
    if folder.as_os_str().is_ascii() || folder.is_dir() {
        return Some(folder.to_owned());
    }
    let Some(Component::Normal(name)) = folder.components().next_back() else { return None };
    let name = decode_name(name.as_encoded_bytes());
    let parent = stored_folder(folder.parent()?)?;
    let is_same = |other: &OsString| composed(&decode_name(other.as_encoded_bytes())) == composed(&name);
    let found = raw_file_names(&parent).ok()?.into_iter().find(is_same)?;
    Some(parent.join(found))
}

impl ImageFolder {
    fn read(folder: &Path) -> Result<Self, DataError> {
        let (by_stem, requested) = (HashMap::new(), HashSet::new());
        let mut read = Self { path: folder.to_owned(), by_stem, unreadable: HashSet::new(), requested };
        for stored in raw_file_names(folder)? {
            let name = decode_name(stored.as_encoded_bytes());
            let (stem, extension) = split_name(&name);
            let Some(extension) = extension.map(str::to_ascii_lowercase) else { continue };
            let stem = composed(stem).into_owned();
            if EXTENSIONS.contains(&extension.as_str()) {
                read.by_stem.entry(stem).or_default().push((name, stored));
            } else if OTHER_EXTENSIONS.contains(&extension.as_str()) {
                read.unreadable.insert(stem);
            }
        }
        Ok(read)
    }
}

/// Returns the images of a folder in the natural order of their names.
pub(crate) fn images_in(folder: &Path) -> Result<Vec<PathBuf>, DataError> {
    let mut names = file_names(folder)?;
    let is_image = |ending: &str| EXTENSIONS.contains(&ending.to_ascii_lowercase().as_str());
    names.retain(|name| split_name(name).1.is_some_and(is_image));
    names.sort_by(|a, b| natural_order(a, b));
    Ok(names.into_iter().map(|name| folder.join(name)).collect())
}

/// Returns the images whose names are numbers (time stamps), by number; of `77` and `077`, the first in order of names.
pub(crate) fn numbered_images(images: &[PathBuf]) -> BTreeMap<i64, &PathBuf> {
    let mut numbered = BTreeMap::new();
    for path in images {
        if let Some(number) = path.file_stem().and_then(|stem| stem.to_str()?.parse().ok()) {
            numbered.entry(number).or_insert(path);
        }
    }
    numbered
}

/// Returns the number of images in a folder and its subfolders, of other formats too.
pub(crate) fn num_images(folder: &Path) -> usize {
    let count = |names: &[String]| names.iter().filter(|name| split_name(name).1.is_some()).count();
    let names = file_names(folder).unwrap_or_default();
    let below = names.iter().map(|name| count(&file_names(&folder.join(name)).unwrap_or_default()));
    count(&names) + below.sum::<usize>()
}

/// Returns stem and extension of a name; the extension only if it is one of an image format.
fn split_name(name: &str) -> (&str, Option<&str>) {
    match name.rsplit_once('.') {
        Some((stem, ending)) if !stem.is_empty() => {
            let lower = ending.to_ascii_lowercase();
            let is_image = EXTENSIONS.iter().chain(&OTHER_EXTENSIONS).any(|known| *known == lower);
            if is_image { (stem, Some(ending)) } else { (name, None) }
        }
        _ => (name, None),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_are_found_with_any_extension_or_none() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["a.JPG", "b.png", "b.jpg", "frame.0001.png", "d.heic", "e.txt"] {
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        let mut folders = ImageFolders::default();
        assert_eq!(folders.find(&folder.path().join("x")).unwrap_err(), "without an image");
        assert_eq!(folders.num_unrequested(), 0, "no image of this folder was requested");
        let mut find = |name: &str| {
            let found = folders.find(&folder.path().join(name));
            found.map(|path| path.file_name().unwrap().to_string_lossy().into_owned())
        };
        assert_eq!(find("a.JPG").as_deref(), Ok("a.JPG"));
        assert_eq!(find("a.png").as_deref(), Ok("a.JPG"));
        assert_eq!(find("a").as_deref(), Ok("a.JPG"));
        assert_eq!(find("b.jpg").as_deref(), Ok("b.jpg"));
        assert_eq!(find("b").unwrap_err(), "with several images of different extensions");
        assert_eq!(find("frame.0001").as_deref(), Ok("frame.0001.png"));
        assert_eq!(find("d.jpg").unwrap_err(), "whose image is neither JPEG nor PNG");
        assert_eq!(find("d").unwrap_err(), "whose image is neither JPEG nor PNG");
        for name in ["c.png", "e.txt", "e", "frame"] {
            assert_eq!(find(name).unwrap_err(), "without an image", "{name}");
        }
        assert_eq!(folders.find(&folder.path().join("nowhere/a.png")).unwrap_err(), "without an image");
        assert_eq!(folders.num_unrequested(), 0);
        std::fs::write(folder.path().join("spare.jpg"), "").unwrap();
        let mut folders = ImageFolders::default();
        folders.find(&folder.path().join("a.JPG")).unwrap();
        assert_eq!(folders.num_unrequested(), 3, "b, frame.0001 and spare");
    }

    #[test]
    fn numbers_are_found_with_or_without_leading_zeros() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["0077.jpg", "77.png", "12.png", "-3.png", "x.png", "9.txt"] {
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        let images = images_in(folder.path()).unwrap();
        let numbered = numbered_images(&images);
        assert_eq!(numbered.keys().copied().collect::<Vec<_>>(), [-3, 12, 77]);
        assert_eq!(*numbered[&77], folder.path().join("0077.jpg"));
    }
}
