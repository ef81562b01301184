//! Which picture file belongs to which camera: joined by name, never by order.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

use crate::error::DataError;
use crate::files::listing::file_names;

/// Endings of the formats that can be decoded, in the order they are preferred.
const EXTENSIONS: [&str; 3] = ["png", "jpg", "jpeg"];
/// Endings of formats that cannot, but that a name may have.
const OTHER_EXTENSIONS: [&str; 8] = ["heic", "webp", "tif", "tiff", "exr", "bmp", "gif", "avif"];

/// The picture files of folders, each folder listed once.
#[derive(Default)]
pub(crate) struct ImageFolders {
    folders: HashMap<PathBuf, Option<PictureFolder>>,
}

/// The picture files of one folder.
struct PictureFolder {
    /// File names by their stem.
    by_stem: HashMap<String, Vec<String>>,
    /// Files of other formats, by stem.
    unreadable: HashMap<String, String>,
    /// Stems that have been looked for and are there.
    asked: HashSet<String>,
}

impl ImageFolders {
    /// Finds a picture by its path: the file of that name, or the only one that differs in its ending alone. The error
    /// is a reason for the ledger.
    pub fn find(&mut self, path: &Path) -> Result<PathBuf, String> {
        let missing = || "without a picture".to_owned();
        let (Some(parent), Some(name)) = (path.parent(), path.file_name().and_then(|name| name.to_str())) else {
            return Err(missing());
        };
        let folder = self.folder(parent).ok_or_else(missing)?;
        let (stem, _) = split_name(name);
        // A name without an ending may have a dot of its own: `frame.0001`.
        let named = [name, stem].into_iter().find(|stem| folder.by_stem.contains_key(*stem));
        folder.asked.extend(named.map(str::to_owned));
        let names = named.and_then(|stem| folder.by_stem.get(stem));
        match names.map(Vec::as_slice) {
            Some(names) if names.iter().any(|other| other == name) => Ok(path.to_owned()),
            Some([only]) => Ok(parent.join(only)),
            Some(_) => Err("with several pictures that differ in their ending".into()),
            None if folder.unreadable.contains_key(stem) => Err("whose picture is neither JPEG nor PNG".into()),
            None => Err(missing()),
        }
    }

    /// How many pictures beside those that were found nobody has looked for.
    pub fn num_unasked(&self) -> usize {
        let folders = self.folders.values().flatten().filter(|folder| !folder.asked.is_empty());
        folders.map(|folder| folder.by_stem.len() - folder.asked.len()).sum()
    }

    /// Whether a folder is there.
    pub fn has(&mut self, folder: &Path) -> bool {
        self.folder(folder).is_some()
    }

    fn folder(&mut self, folder: &Path) -> Option<&mut PictureFolder> {
        let entry = self.folders.entry(folder.to_owned());
        entry.or_insert_with_key(|folder| PictureFolder::read(folder).ok()).as_mut()
    }
}

impl PictureFolder {
    fn read(folder: &Path) -> Result<Self, DataError> {
        let mut read = Self { by_stem: HashMap::new(), unreadable: HashMap::new(), asked: HashSet::new() };
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

/// The pictures of a folder whose names are numbers, by number: time stamps in RealEstate10K. Of two names of one number
/// (`77` and `077`) the first in order of names counts.
pub(crate) fn numbered_pictures(folder: &Path) -> Result<HashMap<i64, PathBuf>, DataError> {
    let mut names = file_names(folder)?;
    names.sort_unstable();
    let mut numbered = HashMap::new();
    for name in names {
        let (stem, extension) = split_name(&name);
        let is_picture = extension.is_some_and(|ending| EXTENSIONS.contains(&ending.to_ascii_lowercase().as_str()));
        if let (true, Ok(number)) = (is_picture, stem.parse()) {
            numbered.entry(number).or_insert_with(|| folder.join(&name));
        }
    }
    Ok(numbered)
}

/// Stem and ending of a name; the ending is `None` unless it is one of pictures.
fn split_name(name: &str) -> (&str, Option<&str>) {
    match name.rsplit_once('.') {
        Some((stem, ending)) if !stem.is_empty() => {
            let lower = ending.to_ascii_lowercase();
            let is_picture = EXTENSIONS.iter().chain(&OTHER_EXTENSIONS).any(|known| *known == lower);
            if is_picture { (stem, Some(ending)) } else { (name, None) }
        }
        _ => (name, None),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_is_found_by_its_name_with_any_ending_or_none() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["a.JPG", "b.png", "b.jpg", "frame.0001.png", "d.heic", "e.txt"] {
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        let mut folders = ImageFolders::default();
        assert_eq!(folders.find(&folder.path().join("x")).unwrap_err(), "without a picture");
        assert_eq!(folders.num_unasked(), 0, "a folder without any picture that is looked for is another's");
        let mut find = |name: &str| {
            let found = folders.find(&folder.path().join(name));
            found.map(|path| path.file_name().unwrap().to_string_lossy().into_owned())
        };
        assert_eq!(find("a.JPG").as_deref(), Ok("a.JPG"));
        assert_eq!(find("a.png").as_deref(), Ok("a.JPG"));
        assert_eq!(find("a").as_deref(), Ok("a.JPG"));
        assert_eq!(find("b.jpg").as_deref(), Ok("b.jpg"));
        assert_eq!(find("b").unwrap_err(), "with several pictures that differ in their ending");
        assert_eq!(find("frame.0001").as_deref(), Ok("frame.0001.png"));
        assert_eq!(find("d.jpg").unwrap_err(), "whose picture is neither JPEG nor PNG");
        assert_eq!(find("d").unwrap_err(), "whose picture is neither JPEG nor PNG");
        for name in ["c.png", "e.txt", "e", "frame"] {
            assert_eq!(find(name).unwrap_err(), "without a picture", "{name}");
        }
        assert_eq!(folders.find(&folder.path().join("nowhere/a.png")).unwrap_err(), "without a picture");
        assert_eq!(folders.num_unasked(), 0);
        std::fs::write(folder.path().join("spare.jpg"), "").unwrap();
        let mut folders = ImageFolders::default();
        folders.find(&folder.path().join("a.JPG")).unwrap();
        assert_eq!(folders.num_unasked(), 3, "b, frame.0001 and spare");
    }

    #[test]
    fn numbers_are_found_with_or_without_leading_zeros() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["0077.jpg", "77.png", "12.png", "-3.png", "x.png", "9.txt"] {
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        let numbered = numbered_pictures(folder.path()).unwrap();
        let mut numbers: Vec<_> = numbered.keys().copied().collect();
        numbers.sort_unstable();
        assert_eq!(numbers, [-3, 12, 77]);
        assert_eq!(numbered[&77], folder.path().join("0077.jpg"));
    }
}
