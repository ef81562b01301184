//! Captures as COLMAP models: `cameras` and `images` as `.bin` or `.txt`, with an image folder. Points are ignored.

use std::collections::{HashSet, VecDeque};
use std::path::{Component, Path, PathBuf};

use crate::error::DataError;
use crate::files::listing::{file_names, natural_order};
use crate::sources::photos::colmap::model::Model;
use crate::sources::photos::colmap::{binary, text};
use crate::sources::photos::image_folder::ImageFolders;
use crate::sources::photos::image_locator::{IMAGE_FOLDERS, first_found, is_absolute, path_suffixes};
use crate::sources::photos::photo::{Photo, PhotoOptions, PhotoScene, unusable};

/// Folders of a scene that hold models, directly or in other folders: `dense/0/sparse`, `sparse/0/models/1`, `sparse/a`.
const BASES: [&str; 4] = ["sparse", "colmap", "dense", "distorted"];
const MAX_DEPTH: usize = 3;
const MAX_MODELS: usize = 1000;

/// Returns the folder of the COLMAP model of a scene: the scene folder, or the model with most images below the first
/// of [`BASES`] that has one. COLMAP writes several models if it cannot connect all images.
pub(crate) fn find_model(folder: &Path) -> Option<PathBuf> {
    if model_files(folder).is_some() {
        return Some(folder.to_owned());
    }
    let models = BASES.iter().map(|base| models_below(&folder.join(base))).find(|models| !models.is_empty())?;
    largest(models).map(|(model, _)| model)
}

/// Returns the models in a folder and below it, upper folders first.
fn models_below(base: &Path) -> Vec<PathBuf> {
    let (mut found, mut folders) = (Vec::new(), VecDeque::from([(base.to_owned(), 0)]));
    while let Some((folder, depth)) = folders.pop_front() {
        let mut names = if depth < MAX_DEPTH { file_names(&folder).unwrap_or_default() } else { Vec::new() };
        names.retain(|name| !name.starts_with("images") && folder.join(name).is_dir());
        names.sort_by(|a, b| natural_order(a, b));
        folders.extend(names.iter().map(|name| (folder.join(name), depth + 1)));
        if model_files(&folder).is_some() {
            found.push(folder);
        }
        if found.len() + folders.len() > MAX_MODELS {
            break;
        }
    }
    found
}

/// Returns the model with most images, the first of several, and that number; a single model is not counted.
fn largest(mut models: Vec<PathBuf>) -> Option<(PathBuf, u64)> {
    if models.len() == 1 {
        return models.pop().map(|model| (model, 0));
    }
    let num_images = |model: &Path| match model_files(model) {
        Some(([_, images], true)) => binary::num_images(&images),
        Some(([_, images], false)) => text::num_images(&images),
        None => 0,
    };
    let counted = models.into_iter().map(|model| (num_images(&model), model));
    let most = counted.reduce(|best, next| if next.0 > best.0 { next } else { best });
    most.map(|(count, model)| (model, count))
}

/// Returns the two files of a model and whether they are binary; binary files take precedence.
fn model_files(model: &Path) -> Option<([PathBuf; 2], bool)> {
    let both = [("bin", true), ("txt", false)].map(|(ending, is_binary)| {
        (["cameras", "images"].map(|name| model.join(format!("{name}.{ending}"))), is_binary)
    });
    both.into_iter().find(|(files, _)| files.iter().all(|file| file.is_file()))
}

/// Reads a model and locates the images of the scene in `folder`. Frames are in the natural order of their names.
pub(crate) fn read_colmap(folder: &Path, model: &Path, options: &PhotoOptions) -> Result<PhotoScene, DataError> {
    let Some(([cameras_path, images_path], is_binary)) = model_files(model) else {
        let what = "expected cameras.bin and images.bin, or cameras.txt and images.txt".into();
        return Err(DataError::BadScene { what, path: model.to_owned() });
    };
    let read = if is_binary { binary::read } else { text::read };
    let Model { cameras, mut images, malformed } = read(&cameras_path, &images_path)?;
    images.sort_by(|a, b| natural_order(&a.name, &b.name));
    let mut folders = ImageFolders::default();
    let image_folder = find_image_folder(folder, model, options, &mut folders);
    let mut scene = PhotoScene { notes: other_models(folder, model), ..PhotoScene::default() };
    for (name, reason) in malformed {
        scene.skip(name, reason);
    }
    let mut used = HashSet::new();
    for image in &images {
        let found = first_found(&image.name, |name| find_image(&image_folder, name, &mut folders));
        let found = found.and_then(|path| {
            if used.insert(path.clone()) { Ok(path) } else { Err("with the image of another frame".into()) }
        });
        let photo = found.and_then(|path| {
            let camera = cameras.get(&image.camera_id);
            let camera = camera.ok_or_else(|| unusable(&format!("no camera {}", image.camera_id)))?;
            let of_camera = |what: &String| unusable(&format!("camera {}: {what}", image.camera_id));
            let camera = camera.as_ref().map_err(of_camera)?;
            let (intrinsics_norm, lens) = camera.optics().map_err(|what| of_camera(&what))?;
            let size = Some([camera.width as f64, camera.height as f64]);
            let photo = |c2w| Photo::new(path, c2w, intrinsics_norm, size, (lens, options.undistort));
            image.c2w().and_then(photo).map_err(|error| unusable(&error))
        });
        match photo {
            Ok(photo) => scene.photos.push(photo),
            Err(reason) => scene.skip(&image.name, reason),
        }
    }
    scene.num_without_camera = folders.num_unrequested();
    Ok(scene)
}

/// Finds an image by its name in the model. Some tools write names with the image folder, `images/0.png`, and some write
/// absolute paths, of which as many last parts count as exist.
fn find_image(image_folder: &Path, name: &str, folders: &mut ImageFolders) -> Result<PathBuf, String> {
    let found = folders.find(&image_folder.join(name));
    found.or_else(|error| {
        let path = Path::new(name);
        let is_folder =
            |part: &Component<'_>| part.as_os_str() == "images" || image_folder.file_name() == Some(part.as_os_str());
        let below: PathBuf = path.components().skip_while(|part| !is_folder(part)).skip(1).collect();
        let suffixes = is_absolute(path).then(|| path_suffixes(path)).into_iter().flatten();
        let mut others = std::iter::once(below).filter(|below| !below.as_os_str().is_empty()).chain(suffixes);
        others.find_map(|below| folders.find(&image_folder.join(below)).ok()).ok_or(error)
    })
}

/// Returns the folder to which the image names are relative.
fn find_image_folder(folder: &Path, model: &Path, options: &PhotoOptions, folders: &mut ImageFolders) -> PathBuf {
    let mut bases: Vec<&Path> = model.ancestors().take_while(|above| above.starts_with(folder)).collect();
    if !bases.contains(&folder) {
        bases.push(folder);
    }
    let names: Vec<&str> = match &options.image_folder {
        Some(name) => vec![name],
        None => IMAGE_FOLDERS.to_vec(),
    };
    let candidates = names.iter().flat_map(|name| bases.iter().map(move |base| base.join(name)));
    let found = candidates.into_iter().find(|candidate| folders.has(candidate));
    found.unwrap_or_else(|| match &options.image_folder {
        Some(name) => folder.join(name),
        None => folder.to_owned(),
    })
}

/// Returns a note on the choice among several models.
fn other_models(folder: &Path, model: &Path) -> Vec<String> {
    let models = BASES
        .iter()
        .map(|base| models_below(&folder.join(base)))
        .find(|models| models.iter().any(|other| other == model));
    let models = models.filter(|models| models.len() > 1).unwrap_or_default();
    let counted = largest(models.clone()).map(|(_, count)| {
        let name = model.strip_prefix(folder).unwrap_or(model).display();
        format!("of {} models of {}, {name} with most images, {count}, is used", models.len(), folder.display())
    });
    counted.into_iter().collect()
}
