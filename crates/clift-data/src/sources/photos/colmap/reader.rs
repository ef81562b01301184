//! Captures as COLMAP models: `cameras` and `images` as `.bin` or `.txt`, next to the images. Points are skipped.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use crate::error::DataError;
use crate::files::listing::natural_order;
use crate::sources::photos::colmap::model::Model;
use crate::sources::photos::colmap::{binary, text};
use crate::sources::photos::image_folder::ImageFolders;
use crate::sources::photos::photo::{MissingPhoto, Photo, PhotoOptions, PhotoScene};

/// The COLMAP model of a folder: the folder itself, or one of the usual subfolders.
pub(crate) fn find_model(folder: &Path) -> Option<PathBuf> {
    let places = ["", "sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "dense/sparse/0", "dense/sparse"];
    let mut models = places.into_iter().map(|place| if place.is_empty() { folder.into() } else { folder.join(place) });
    models.find(|model| files_of(model).is_some())
}

/// The two files of a model, binary ones first.
fn files_of(model: &Path) -> Option<([PathBuf; 2], bool)> {
    let both = [("bin", true), ("txt", false)].map(|(ending, is_binary)| {
        (["cameras", "images"].map(|name| model.join(format!("{name}.{ending}"))), is_binary)
    });
    both.into_iter().find(|(files, _)| files.iter().all(|file| file.is_file()))
}

/// Reads the model in `model` and locates the images of the scene in `folder`. Frames are in the natural order of their
/// names.
///
/// # Errors
/// [`DataError::Io`], and [`DataError::BadScene`] for a malformed file or an unsupported camera.
pub(crate) fn read_colmap(folder: &Path, model: &Path, options: &PhotoOptions) -> Result<PhotoScene, DataError> {
    let Some(([cameras_path, images_path], is_binary)) = files_of(model) else {
        let what = "neither cameras.bin and images.bin nor cameras.txt and images.txt".into();
        return Err(DataError::BadScene { what, path: model.to_owned() });
    };
    let read = if is_binary { binary::read } else { text::read };
    let Model { cameras, mut images } = read(&cameras_path, &images_path)?;
    let mut optics = HashMap::with_capacity(cameras.len());
    for (id, camera) in &cameras {
        let bad =
            |what: String| DataError::BadScene { what: format!("camera {id}: {what}"), path: cameras_path.clone() };
        optics.insert(id, camera.optics().map_err(bad)?);
    }
    images.sort_by(|a, b| natural_order(&a.name, &b.name));
    let mut folders = ImageFolders::default();
    let pictures = picture_folder(folder, model, options, &mut folders);
    let mut scene = PhotoScene { notes: other_models(model), ..PhotoScene::default() };
    for (place, image) in images.iter().enumerate() {
        let found = match place.checked_sub(1).map(|before| &images[before].name) {
            Some(before) if *before == image.name => Err("whose picture another frame has".into()),
            _ => folders.find(&pictures.join(&image.name)),
        };
        let picture = match found {
            Ok(picture) => picture,
            Err(reason) => {
                scene.missing.push(MissingPhoto { name: image.name.clone(), reason });
                continue;
            }
        };
        let in_frame = |error| PhotoScene::in_frame(&images_path, &image.name)(error);
        let Some((intrinsics_norm, lens)) = optics.get(&image.camera_id) else {
            let what = format!("there is no camera {}", image.camera_id);
            return Err(in_frame(DataError::BadCamera { what }));
        };
        let photo = image
            .c2w()
            .and_then(|c2w| Photo::new(picture, c2w, *intrinsics_norm, *lens, options.undistort))
            .map_err(in_frame)?;
        let camera = &cameras[&image.camera_id];
        scene.photos.push(Photo { shape: Some(camera.width as f64 / camera.height as f64), ..photo });
    }
    scene.num_without_camera = folders.num_unasked();
    Ok(scene)
}

/// The folder to which image names are relative.
fn picture_folder(folder: &Path, model: &Path, options: &PhotoOptions, folders: &mut ImageFolders) -> PathBuf {
    let mut bases: Vec<&Path> = model.ancestors().take_while(|above| above.starts_with(folder)).collect();
    if !bases.contains(&folder) {
        bases.push(folder);
    }
    let names: Vec<&str> = match &options.image_folder {
        Some(name) => vec![name],
        None => vec!["images", "images_2", "images_4", "images_8"],
    };
    let candidates = names.iter().flat_map(|name| bases.iter().map(move |base| base.join(name)));
    let found = candidates.into_iter().find(|candidate| folders.has(candidate));
    found.unwrap_or_else(|| match &options.image_folder {
        Some(name) => folder.join(name),
        None => folder.to_owned(),
    })
}

/// A note on models beside that in `sparse/0`: COLMAP writes several if it cannot connect all images.
fn other_models(model: &Path) -> Vec<String> {
    if model.file_name().is_none_or(|name| name != "0") {
        return Vec::new();
    }
    let others = (1..100).take_while(|number| files_of(&model.with_file_name(number.to_string())).is_some()).count();
    let note = || format!("{} has {others} more models, which are not used: only model 0 is", model.display());
    (others > 0).then(note).into_iter().collect()
}
