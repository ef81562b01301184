//! Look-up of image files by name.

use std::collections::{HashMap, HashSet};
use std::ffi::OsString;
use std::path::{Path, PathBuf};

use crate::error::DataError;
use crate::files::listing::{decode_name, file_names, natural_order, raw_file_names};
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

#[derive(Default)]
struct ImageFolder {
    path: PathBuf,
    /// Images by stem: decoded names, and names as stored.
    by_stem: HashMap<String, Vec<(String, OsString)>>,
    /// Stems of files of other formats.
    unreadable: HashSet<String>,
}

impl ImageFolders {
    /// Finds an image by its path: the file of that name, or the only file of that stem, in any encoding.
    ///
    /// # Errors
    /// A reason for the skip report.
    pub fn find(&mut self, path: &Path) -> Result<PathBuf, String> {
        let missing = || NO_IMAGE.to_owned();
        let name = decode_name(path.file_name().ok_or_else(missing)?.as_encoded_bytes());
        let folder = path.parent().and_then(|parent| self.folder(parent)).ok_or_else(missing)?;
        let (stem, _) = split_name(&name);
        // A name without an extension may contain a dot: `frame.0001`.
        match [name.as_str(), stem].into_iter().find_map(|stem| folder.by_stem.get(stem)).map(Vec::as_slice) {
            Some([(_, only)]) => Ok(folder.path.join(only)),
            Some(names) => {
                let same = names.iter().find(|(other, _)| *other == name);
                let several = || "with several images of different extensions".to_owned();
                same.map(|(_, stored)| folder.path.join(stored)).ok_or_else(several)
            }
            None if folder.unreadable.contains(stem) => Err("whose image is neither JPEG nor PNG".into()),
            None => Err(missing()),
        }
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

    fn folder(&mut self, folder: &Path) -> Option<&ImageFolder> {
        let entry = self.folders.entry(folder.to_owned());
        let read = |folder: &Path| ImageFolder::read(folder).ok();
        entry.or_insert_with_key(|folder| read(folder).or_else(|| read(&stored_folder(folder)?))).as_ref()
    }
}

/// Returns the folder whose path has the same characters in another encoding.
fn stored_folder(folder: &Path) -> Option<PathBuf> {
    if folder.as_os_str().is_ascii() || folder.is_dir() {
        return Some(folder.to_owned());
    }
    let (parent, name) = (stored_folder(folder.parent()?)?, decode_name(folder.file_name()?.as_encoded_bytes()));
    let is_same = |other: &OsString| decode_name(other.as_encoded_bytes()) == name;
    Some(parent.join(raw_file_names(&parent).ok()?.into_iter().find(is_same)?))
}

impl ImageFolder {
    fn read(folder: &Path) -> Result<Self, DataError> {
        let mut read = Self { path: folder.to_owned(), ..Self::default() };
        for stored in raw_file_names(folder)? {
            let name = decode_name(stored.as_encoded_bytes());
            let (stem, extension) = split_name(&name);
            let Some(extension) = extension.map(str::to_ascii_lowercase) else { continue };
            let stem = stem.to_owned();
            if EXTENSIONS.contains(&extension.as_str()) {
                read.by_stem.entry(stem).or_default().push((name, stored));
            } else {
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
        for (name, expected) in [
            ("a.JPG", Ok("a.JPG")),
            ("a.png", Ok("a.JPG")),
            ("a", Ok("a.JPG")),
            ("b.jpg", Ok("b.jpg")),
            ("b", Err("with several images of different extensions")),
            ("frame.0001", Ok("frame.0001.png")),
            ("d.jpg", Err("whose image is neither JPEG nor PNG")),
            ("c.png", Err("without an image")),
            ("e.txt", Err("without an image")),
            ("frame", Err("without an image")),
            ("nowhere/a.png", Err("without an image")),
        ] {
            let found = folders.find(&folder.path().join(name));
            let expected = expected.map(|name| folder.path().join(name)).map_err(str::to_owned);
            assert_eq!(found, expected, "{name}");
        }
    }
}
