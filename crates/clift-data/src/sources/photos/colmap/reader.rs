//! Captures as COLMAP models: `cameras` and `images` as `.bin` or `.txt`, with an image folder. Points are ignored.

use std::collections::{HashSet, VecDeque};
use std::path::{Path, PathBuf};

use crate::error::DataError;
use crate::files::listing::{file_names, natural_order};
use crate::sources::photos::colmap::model::Model;
use crate::sources::photos::colmap::{binary, text};
use crate::sources::photos::image_locator::ImageLocator;
use crate::sources::photos::photo::{Photo, PhotoOptions, PhotoScene, unusable};

/// Folders of a scene that hold models, directly or in other folders: `dense/0/sparse`, `sparse/0/models/1`, `sparse/a`.
const BASES: [&str; 4] = ["sparse", "colmap", "dense", "distorted"];
const MAX_DEPTH: usize = 3;
const MAX_MODELS: usize = 1000;

/// Returns the folder of the COLMAP model of a scene: the scene folder, or the model with most images in the first of
/// [`BASES`] that has one. COLMAP writes several models if it cannot connect all images.
pub(crate) fn find_model(folder: &Path) -> Option<PathBuf> {
    if model_files(folder).is_some() {
        return Some(folder.to_owned());
    }
    models_of(folder).into_iter().rev().max_by_key(|model| num_images(model))
}

/// Returns the models in the first of [`BASES`] that has one, upper folders first.
fn models_of(folder: &Path) -> Vec<PathBuf> {
    let models = BASES.iter().map(|base| {
        let (mut found, mut folders) = (Vec::new(), VecDeque::from([(folder.join(base), 0)]));
        while let Some((folder, depth)) = folders.pop_front() {
            let mut names = if depth < MAX_DEPTH { file_names(&folder).unwrap_or_default() } else { Vec::new() };
            names.retain(|name| !name.starts_with("images") && folder.join(name).is_dir());
            names.sort_by(|a, b| natural_order(a, b));
            folders.extend(names.iter().map(|name| (folder.join(name), depth + 1)));
            found.extend(model_files(&folder).map(|_| folder));
            if found.len() + folders.len() > MAX_MODELS {
                break;
            }
        }
        found
    });
    models.into_iter().find(|models| !models.is_empty()).unwrap_or_default()
}

fn num_images(model: &Path) -> u64 {
    match model_files(model) {
        Some(([_, images], true)) => binary::num_images(&images),
        Some(([_, images], false)) => text::num_images(&images),
        None => 0,
    }
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
    let mut read = Model::default();
    if is_binary {
        binary::read_cameras(&cameras_path, &mut read)?;
        binary::read_images(&images_path, &mut read)?;
    } else {
        text::read_cameras(&cameras_path, &mut read)?;
        text::read_images(&images_path, &mut read)?;
    }
    let Model { cameras, mut images, malformed } = read;
    images.sort_by(|a, b| natural_order(&a.name, &b.name));
    let mut locator = ImageLocator::for_model(folder, model, options);
    let mut scene = PhotoScene::default();
    let models = if model == folder { Vec::new() } else { models_of(folder) };
    if models.len() > 1 {
        let (count, name) = (num_images(model), model.strip_prefix(folder).unwrap_or(model).display());
        let (num_models, folder) = (models.len(), folder.display());
        scene.notes.push(format!("of {num_models} models of {folder}, {name} with most images, {count}, is used"));
    }
    for (name, reason) in malformed {
        scene.skip(name, reason);
    }
    let mut used = HashSet::new();
    for image in &images {
        let found = locator.find(&image.name);
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
    Ok(scene)
}
