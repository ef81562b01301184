//! Own captures as COLMAP models: `cameras` and `images` as `.bin` or `.txt`, next to the pictures.
//!
//! Poses are world to camera with OpenCV's axes. Points are passed over.

mod binary;
mod text;

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use crate::camera::{Intrinsics, IntrinsicsNorm, Pose};
use crate::error::DataError;
use crate::lens::Lens;
use crate::listing::natural_order;
use crate::photo::{MAX_FRAMES, MissingPhoto, Photo, PhotoOptions, PhotoScene};
use crate::picture_folder::PictureFolders;

/// Most cameras of a model: one per image.
const MAX_CAMERAS: usize = MAX_FRAMES;
/// Longest name of an image, in bytes.
const MAX_NAME_BYTES: usize = 4096;

/// Names of COLMAP's camera models and how many parameters each has, by number.
const MODELS: [(&str, usize); 11] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
];

/// A camera of a model.
#[derive(Clone, Debug, PartialEq)]
struct ColmapCamera {
    model: String,
    width: u64,
    height: u64,
    params: Vec<f64>,
}

impl ColmapCamera {
    /// Intrinsics over width and height, and the lens.
    fn optics(&self) -> Result<(IntrinsicsNorm, Lens), String> {
        let (focal, centre, distortion) = match (self.model.as_str(), self.params.as_slice()) {
            ("SIMPLE_PINHOLE", &[f, cx, cy]) => ([f, f], [cx, cy], [0.0; 4]),
            ("PINHOLE", &[fx, fy, cx, cy]) => ([fx, fy], [cx, cy], [0.0; 4]),
            ("SIMPLE_RADIAL", &[f, cx, cy, k]) => ([f, f], [cx, cy], [k, 0.0, 0.0, 0.0]),
            ("RADIAL", &[f, cx, cy, k1, k2]) => ([f, f], [cx, cy], [k1, k2, 0.0, 0.0]),
            ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => ([fx, fy], [cx, cy], [k1, k2, p1, p2]),
            (model, params) => {
                return Err(match MODELS.iter().find(|(name, _)| *name == model) {
                    Some((_, count)) if *count != params.len() => {
                        format!("{model} has {} parameters, expected {count}", params.len())
                    }
                    _ => format!(
                        "the model is {model}, expected SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL or OPENCV; \
                         `colmap image_undistorter` turns any into PINHOLE"
                    ),
                });
            }
        };
        if self.width == 0 || self.height == 0 {
            return Err(format!("it is {}x{} pixels", self.width, self.height));
        }
        let intrinsics = Intrinsics { fx: focal[0], fy: focal[1], cx: centre[0], cy: centre[1] };
        let intrinsics_norm = IntrinsicsNorm::of_pixels(intrinsics, self.width as f64, self.height as f64);
        let [k1, k2, p1, p2] = distortion;
        let lens = Lens { radial: [k1, k2, 0.0], tangential: [p1, p2] };
        let checked = intrinsics_norm.validate().and_then(|()| lens.validate());
        checked.map(|()| (intrinsics_norm, lens)).map_err(|error| error.to_string())
    }
}

/// An image of a model.
#[derive(Clone, Debug, PartialEq)]
struct ColmapImage {
    name: String,
    camera_id: u32,
    /// World to camera: `w x y z`, and the translation.
    rotation: [f64; 4],
    translation: [f64; 3],
}

impl ColmapImage {
    fn c2w(&self) -> Result<Pose, DataError> {
        let bad = |what: String| DataError::BadCamera { what };
        if let Some(value) = self.rotation.iter().chain(&self.translation).find(|value| !value.is_finite()) {
            return Err(bad(format!("the pose holds {value}")));
        }
        let norm = self.rotation.iter().map(|value| value * value).sum::<f64>().sqrt();
        // COLMAP writes unit quaternions; what is far from that is something else.
        if !(0.9..1.1).contains(&norm) {
            return Err(bad(format!("the quaternion has length {norm:.3}, expected 1")));
        }
        let [w, x, y, z] = self.rotation.map(|value| value / norm);
        let rotation = [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ];
        Ok(Pose { rotation, translation: self.translation }.inverse())
    }
}

/// Cameras by their number, and images in the order of the file.
#[derive(Debug, Default, PartialEq)]
struct Model {
    cameras: HashMap<u32, ColmapCamera>,
    images: Vec<ColmapImage>,
}

/// Where a folder has a COLMAP model: itself, or one of the places where COLMAP and its users put them.
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

/// Reads the model in `model` and finds the pictures of the scene in `folder`. Frames are in the natural order of their
/// names.
///
/// # Errors
/// [`DataError::Io`], and [`DataError::BadScene`] for a file of another form or a camera that cannot be used.
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
    let mut folders = PictureFolders::default();
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

/// The folder that the names of images are relative to.
fn picture_folder(folder: &Path, model: &Path, options: &PhotoOptions, folders: &mut PictureFolders) -> PathBuf {
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

/// A note on models beside the one in `sparse/0`: COLMAP makes several where it cannot connect all images.
fn other_models(model: &Path) -> Vec<String> {
    if model.file_name().is_none_or(|name| name != "0") {
        return Vec::new();
    }
    let others = (1..100).take_while(|number| files_of(&model.with_file_name(number.to_string())).is_some()).count();
    let note = || format!("{} has {others} more models, which are not used: only model 0 is", model.display());
    (others > 0).then(note).into_iter().collect()
}

/// What both forms check of a model.
fn add_camera(cameras: &mut HashMap<u32, ColmapCamera>, id: u32, camera: ColmapCamera) -> Result<(), String> {
    if cameras.len() == MAX_CAMERAS {
        return Err(format!("more than {MAX_CAMERAS} cameras"));
    }
    match cameras.insert(id, camera) {
        None => Ok(()),
        Some(_) => Err(format!("camera {id} comes twice")),
    }
}

/// What both forms check of a model.
fn add_image(images: &mut Vec<ColmapImage>, image: ColmapImage) -> Result<(), String> {
    if images.len() == MAX_FRAMES {
        return Err(format!("more than {MAX_FRAMES} images"));
    }
    images.push(image);
    Ok(())
}
