//! Captures as COLMAP models: `cameras` and `images` as `.bin` or `.txt`, with an image folder. Points are ignored.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use crate::error::DataError;
use crate::files::listing::natural_order;
use crate::skip_report::plural;
use crate::sources::photos::colmap::model::Model;
use crate::sources::photos::colmap::{binary, text};
use crate::sources::photos::image_folder::ImageFolders;
use crate::sources::photos::photo::{Photo, PhotoOptions, PhotoScene};

/// Returns the folder of the COLMAP model of a scene: the scene folder, or one of the usual subfolders.
pub(crate) fn find_model(folder: &Path) -> Option<PathBuf> {
    let subfolders = ["", "sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "dense/sparse/0", "dense/sparse"];
    let mut models = subfolders.into_iter().map(|name| if name.is_empty() { folder.into() } else { folder.join(name) });
    models.find(|model| model_files(model).is_some())
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
    let Model { cameras, mut images } = read(&cameras_path, &images_path)?;
    let mut optics = HashMap::with_capacity(cameras.len());
    for (id, camera) in &cameras {
        let bad =
            |what: String| DataError::BadScene { what: format!("camera {id}: {what}"), path: cameras_path.clone() };
        optics.insert(id, camera.optics().map_err(bad)?);
    }
    images.sort_by(|a, b| natural_order(&a.name, &b.name));
    let mut folders = ImageFolders::default();
    let image_folder = find_image_folder(folder, model, options, &mut folders);
    let mut scene = PhotoScene { notes: other_models(model), ..PhotoScene::default() };
    for (index, image) in images.iter().enumerate() {
        let found = match index.checked_sub(1).map(|before| &images[before].name) {
            Some(before) if *before == image.name => Err("with the image of another frame".into()),
            _ => folders.find(&image_folder.join(&image.name)),
        };
        let path = match found {
            Ok(path) => path,
            Err(reason) => {
                scene.skip(&image.name, reason);
                continue;
            }
        };
        let in_frame = |error| PhotoScene::in_frame(&images_path, &image.name)(error);
        let Some((intrinsics_norm, lens)) = optics.get(&image.camera_id) else {
            return Err(in_frame(DataError::bad_camera(format!("no camera {}", image.camera_id))));
        };
        let camera = &cameras[&image.camera_id];
        let size = Some([camera.width as f64, camera.height as f64]);
        let photo = image
            .c2w()
            .and_then(|c2w| Photo::new(path, c2w, *intrinsics_norm, size, (*lens, options.undistort)))
            .map_err(in_frame)?;
        scene.photos.push(photo);
    }
    scene.num_without_camera = folders.num_unrequested();
    Ok(scene)
}

/// Returns the folder to which the image names are relative.
fn find_image_folder(folder: &Path, model: &Path, options: &PhotoOptions, folders: &mut ImageFolders) -> PathBuf {
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

/// Returns a note on models beside `sparse/0`: COLMAP writes several models if it cannot connect all images.
fn other_models(model: &Path) -> Vec<String> {
    if model.file_name().is_none_or(|name| name != "0") {
        return Vec::new();
    }
    let others = (1..100).take_while(|number| model_files(&model.with_file_name(number.to_string())).is_some()).count();
    let folder = model.parent().unwrap_or(model).display();
    let note = || format!("{folder} has {}; only model 0 is used", plural(others, "more model"));
    (others > 0).then(note).into_iter().collect()
}
