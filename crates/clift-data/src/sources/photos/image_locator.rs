//! Images named by a camera file, wherever they are.

use std::borrow::Cow;
use std::path::{Component, Path, PathBuf};

use percent_encoding::percent_decode_str;

use crate::sources::photos::image_folder::ImageFolders;
use crate::sources::photos::photo::{NO_IMAGE, PhotoOptions};

/// Folders of images, and of scaled copies of them.
const IMAGE_FOLDERS: [&str; 4] = ["images", "images_2", "images_4", "images_8"];

/// Largest number of trailing parts of an image path that are searched in the scene folder.
const MAX_SUFFIX_PARTS: usize = 32;

/// Finds the images of a scene folder by the names in its camera file.
pub(crate) struct ImageLocator<'a> {
    folder: &'a Path,
    folders: ImageFolders,
    /// The folder of the images, or that to which their names are relative.
    image_folder: PathBuf,
    /// Whether the options name the folder of the images, which then replaces the first folder of a name.
    is_chosen: bool,
}

impl<'a> ImageLocator<'a> {
    /// Locates images whose names are relative to the scene folder.
    pub fn new(folder: &'a Path, options: &PhotoOptions) -> Self {
        let mut folders = ImageFolders::default();
        let chosen = chosen_folder(folder, options, &mut folders);
        // Only scaled copies may exist.
        let first = IMAGE_FOLDERS.iter().map(|name| folder.join(name)).find(|folder| folders.has(folder));
        let only_scaled = first.filter(|first| !first.ends_with(IMAGE_FOLDERS[0]));
        let is_chosen = chosen.is_some();
        let image_folder = chosen.or(only_scaled).unwrap_or_else(|| folder.to_owned());
        Self { folder, folders, image_folder, is_chosen }
    }

    /// Locates images whose names are relative to an image folder beside a COLMAP model.
    pub fn for_model(folder: &'a Path, model: &Path, options: &PhotoOptions) -> Self {
        let mut folders = ImageFolders::default();
        let names = options.image_folder.as_ref().map_or_else(|| IMAGE_FOLDERS.to_vec(), |name| vec![name]);
        let bases: Vec<&Path> = model.ancestors().take_while(|above| above.starts_with(folder)).collect();
        let candidates = names.iter().flat_map(|name| bases.iter().map(move |base| base.join(name)));
        let found = candidates.into_iter().find(|candidate| folders.has(candidate));
        let missing = || options.image_folder.as_ref().map_or_else(|| folder.to_owned(), |name| folder.join(name));
        let (image_folder, is_chosen) = (found.unwrap_or_else(missing), options.image_folder.is_some());
        Self { folder, folders, image_folder, is_chosen }
    }

    /// Returns the path of an image, or why there is none. The name may have the separators of Windows or the `%20` of a URL,
    /// begin with the image folder, or be an absolute path of another computer, of which as many last parts count as exist.
    pub fn find(&mut self, name: &str) -> Result<PathBuf, String> {
        let slashes = name.replace('\\', "/");
        let decoded = percent_decode_str(&slashes).decode_utf8().ok().map(Cow::into_owned);
        self.find_as(name).or_else(|error| {
            let others = [Some(slashes.clone()), decoded].into_iter().flatten().filter(|other| other != name);
            others.into_iter().find_map(|other| self.find_as(&other).ok()).ok_or(error)
        })
    }

    fn find_as(&mut self, name: &str) -> Result<PathBuf, String> {
        let named = Path::new(name);
        let parts: Vec<_> = named.components().filter(|part| matches!(part, Component::Normal(_))).collect();
        let suffix = |start: usize| -> PathBuf { parts[start.min(parts.len())..].iter().collect() };
        let mut candidates = Vec::new();
        if is_absolute(named) {
            candidates.extend((!self.is_chosen).then(|| named.to_owned()));
            for below in (parts.len().saturating_sub(MAX_SUFFIX_PARTS)..parts.len()).map(suffix) {
                candidates.push(self.image_folder.join(&below));
                if !self.is_chosen {
                    candidates.extend(IMAGE_FOLDERS.map(|folder| self.folder.join(folder).join(&below)));
                }
            }
        } else {
            candidates.push(self.image_folder.join(named));
            // `images/0.png`, `attic/images/0.png`.
            let at_images = parts.iter().position(|part| part.as_os_str() == "images");
            let is_named = at_images.is_some() || name.trim_start_matches("./").starts_with("images");
            if parts.len() > 1 && (self.is_chosen || is_named && self.image_folder != self.folder) {
                candidates.push(self.image_folder.join(suffix(at_images.map_or(1, |at| at + 1))));
            }
            candidates.extend((!self.is_chosen).then(|| self.folder.join(named)));
        }
        let mut reason = NO_IMAGE.to_owned();
        for candidate in candidates {
            match self.folders.find(&candidate) {
                Ok(path) => return Ok(path),
                Err(other) if reason == NO_IMAGE => reason = other,
                Err(_) => {}
            }
        }
        Err(reason)
    }
}

/// Returns the configured image folder, or of the first folders of the options that whose images have the smallest size, or
/// else the first that exists.
fn chosen_folder(folder: &Path, options: &PhotoOptions, folders: &mut ImageFolders) -> Option<PathBuf> {
    if let Some(name) = &options.image_folder {
        return Some(folder.join(name));
    }
    let mut existing: Vec<PathBuf> = options.first_folders.iter().map(|name| folder.join(name)).collect();
    existing.retain(|folder| folders.has(folder));
    let large = existing.iter().position(|folder| folders.is_at_least(folder, options.min_size));
    (!existing.is_empty()).then(|| existing.swap_remove(large.unwrap_or_default()))
}

/// Returns whether a path is absolute, on Windows or on other systems.
fn is_absolute(path: &Path) -> bool {
    let first = path.components().next().map(|part| part.as_os_str().to_string_lossy());
    path.has_root() || first.is_some_and(|first| first.len() == 2 && first.ends_with(':'))
}
