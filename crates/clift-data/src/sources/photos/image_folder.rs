//! Look-up of image files by name.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

use crate::error::DataError;
use crate::files::listing::file_names;
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
    by_stem: HashMap<String, Vec<String>>,
    /// Files of other formats, by stem.
    unreadable: HashMap<String, String>,
    /// Requested stems with an image.
    requested: HashSet<String>,
}

impl ImageFolders {
    /// Finds an image by its path: the file of that name, or the only file of that stem.
    ///
    /// # Errors
    /// A reason for the skip report.
    pub fn find(&mut self, path: &Path) -> Result<PathBuf, String> {
        let missing = || NO_IMAGE.to_owned();
        let (Some(parent), Some(name)) = (path.parent(), path.file_name().and_then(|name| name.to_str())) else {
            return Err(missing());
        };
        let folder = self.folder(parent).ok_or_else(missing)?;
        let (stem, _) = split_name(name);
        // A name without an extension may contain a dot: `frame.0001`.
        let named = [name, stem].into_iter().find(|stem| folder.by_stem.contains_key(*stem));
        folder.requested.extend(named.map(str::to_owned));
        let names = named.and_then(|stem| folder.by_stem.get(stem));
        match names.map(Vec::as_slice) {
            Some(names) if names.iter().any(|other| other == name) => Ok(path.to_owned()),
            Some([only]) => Ok(parent.join(only)),
            Some(_) => Err("with several images of different extensions".into()),
            None if folder.unreadable.contains_key(stem) => Err("whose image is neither JPEG nor PNG".into()),
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

    fn folder(&mut self, folder: &Path) -> Option<&mut ImageFolder> {
        let entry = self.folders.entry(folder.to_owned());
        entry.or_insert_with_key(|folder| ImageFolder::read(folder).ok()).as_mut()
    }
}

impl ImageFolder {
    fn read(folder: &Path) -> Result<Self, DataError> {
        let mut read = Self { by_stem: HashMap::new(), unreadable: HashMap::new(), requested: HashSet::new() };
        for name in file_names(folder)? {
            let (stem, extension) = split_name(&name);
            let Some(extension) = extension.map(str::to_ascii_lowercase) else { continue };
            if EXTENSIONS.contains(&extension.as_str()) {
                read.by_stem.entry(stem.to_owned()).or_default().push(name);
            } else if OTHER_EXTENSIONS.contains(&extension.as_str()) {
                read.unreadable.insert(stem.to_owned(), name);
            }
        }
        Ok(read)
    }
}

/// Returns the images whose names are numbers (time stamps), by number; of `77` and `077`, the first in order of names.
pub(crate) fn numbered_images(folder: &Path) -> Result<HashMap<i64, PathBuf>, DataError> {
    let mut numbered = HashMap::new();
    for name in file_names(folder)? {
        let (stem, extension) = split_name(&name);
        let is_image = extension.is_some_and(|ending| EXTENSIONS.contains(&ending.to_ascii_lowercase().as_str()));
        if let (true, Ok(number)) = (is_image, stem.parse()) {
            numbered.entry(number).or_insert_with(|| folder.join(&name));
        }
    }
    Ok(numbered)
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
        let numbered = numbered_images(folder.path()).unwrap();
        let mut numbers: Vec<_> = numbered.keys().copied().collect();
        numbers.sort_unstable();
        assert_eq!(numbers, [-3, 12, 77]);
        assert_eq!(numbered[&77], folder.path().join("0077.jpg"));
    }
}
