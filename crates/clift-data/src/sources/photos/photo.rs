//! An image file with its camera, and a scene of such photos, in any layout with one file per frame.

use std::fmt::Display;
use std::path::{Path, PathBuf};

use clift_core::{Camera, DMat3, IntrinsicsNorm, Pose, RgbImage};
use image::ImageFormat;
use image::metadata::Orientation;
use serde::{Deserialize, Serialize};

use crate::error::DataError;
use crate::files::bounded::read_bounded;
use crate::files::listing::decode_name;
use crate::geometry::lens::Lens;
use crate::image::codec::{
    apply_orientation, check_end, decode_image, decode_with_alpha, exif_orientation, has_alpha, read_header,
};
use crate::image::fit::covering_size;
use crate::image::jpeg_scan::check_image;
use crate::image::lanczos::resize_lanczos;
use crate::image::undistort::Undistortion;
use crate::sources::filters::SceneFilters;

pub(crate) const MAX_FRAMES: usize = 100_000;
/// Largest size of an image file, in bytes.
const MAX_IMAGE_BYTES: u64 = 256 << 20;
/// Photos are reduced to this multiple of the size that they must cover before their lens distortion is removed.
const UNDISTORTED_SCALE: usize = 4;
/// Largest relative error of an image's aspect ratio against its camera's: rounding of images a few dozen pixels wide.
const MAX_SHAPE_ERROR: f64 = 0.02;

/// Pixels of a photo with an EXIF orientation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PosesFrom {
    /// Pixels as the file stores them.
    #[default]
    Stored,
    /// Pixels turned by the orientation.
    Turned,
}

#[derive(Clone, Debug, Default)]
pub(crate) struct PhotoOptions {
    /// Image folder beside the camera file, instead of the folder in the camera file.
    pub image_folder: Option<String>,
    /// Default image folders, tried before the folder in the camera file.
    pub first_folders: &'static [&'static str],
    /// Whether images are undistorted; otherwise lens distortion is ignored.
    pub undistort: bool,
    /// Smallest columns and rows of an image.
    pub min_size: [usize; 2],
    /// Colour of masked and transparent pixels.
    pub background: [u8; 3],
    /// Pixels from which poses were computed where the cameras fit both.
    pub poses_from: PosesFrom,
    /// Filters of the scenes.
    pub filters: SceneFilters,
    /// Whether scenes with an unusable frame are skipped: published evaluation indices refer to complete scenes.
    pub whole_scenes: bool,
    /// Whether large photos stay in memory, scaled to cover `min_size`.
    pub caches_photos: bool,
}

#[derive(Clone, Debug)]
pub(crate) struct Photo {
    pub path: PathBuf,
    /// Pinhole camera of the loaded image.
    pub camera: Camera<IntrinsicsNorm>,
    /// Undistortion applied on load.
    pub undistortion: Option<Box<Undistortion>>,
    /// Aspect ratio (width over height) of the images to which the intrinsics apply.
    pub shape: Option<f64>,
    /// Mask of the image: pixels of 0 are left out.
    pub mask: Option<PathBuf>,
    /// Whether the frame is held out of training; `None` if the camera file does not say.
    pub is_held_out: Option<bool>,
    /// Orientation by which the undistorted image is turned, as `camera` was.
    pub view_turn: Orientation,
    /// Pixels from which the pose was computed, where the camera fits both.
    pub poses_from: PosesFrom,
}

/// How a photo is rotated according to its EXIF orientation. Some tools rotate photos before they compute the cameras; others,
/// such as COLMAP, use the stored pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Turn {
    /// Turns the pixels alone, to those of the camera.
    pub pixels: Orientation,
    /// Turns image and camera together, so that the view is upright.
    pub view: Orientation,
    /// Whether the cameras fit the stored and the turned pixels.
    pub is_undecided: bool,
}

impl Turn {
    pub const NONE: Self =
        Self { pixels: Orientation::NoTransforms, view: Orientation::NoTransforms, is_undecided: false };
}

/// [`MissingPhoto::reason`] of a file that does not exist.
pub(crate) const NO_IMAGE: &str = "without an image";

/// Returns the reason to skip a frame whose camera has this error.
pub(crate) fn unusable(error: &impl Display) -> String {
    format!("whose camera cannot be used: {error}")
}

/// A frame without a usable image, by its name in the camera file.
pub(crate) struct MissingPhoto {
    pub name: String,
    /// Reason, with the same text for equal cases; it completes "a frame ..".
    pub reason: String,
}

/// Photos of a scene, in frame order.
#[derive(Default)]
pub(crate) struct PhotoScene {
    pub photos: Vec<Photo>,
    pub missing: Vec<MissingPhoto>,
    /// Notes for the skip report.
    pub notes: Vec<String>,
}

impl Photo {
    /// Creates a photo. With `undistort`, the image is undistorted on load; otherwise `lens` is ignored. `size` are the columns
    /// and rows that the camera file gives; without them neither the aspect ratio nor the EXIF orientation is checked.
    pub fn new(
        path: PathBuf,
        c2w: Pose,
        intrinsics_norm: IntrinsicsNorm,
        size: Option<[f64; 2]>,
        (lens, undistort): (Lens, bool),
    ) -> Result<Self, DataError> {
        intrinsics_norm.validate()?;
        if !undistort && lens.is_fisheye {
            let what =
                "the images of a fisheye lens are not those of a pinhole camera; set data.files.undistort to true";
            return Err(DataError::bad_camera(what.into()));
        }
        let mut photo = Self::pinhole(path, Camera { intrinsics: intrinsics_norm, c2w });
        photo.shape = size.map(|[width, height]| width / height);
        if undistort && !lens.is_pinhole() {
            let undistortion = Undistortion::new(intrinsics_norm, lens)?;
            photo.camera.intrinsics = undistortion.intrinsics_norm();
            photo.undistortion = Some(Box::new(undistortion));
        }
        Ok(photo)
    }

    /// Creates a photo of a pinhole camera.
    pub fn pinhole(path: PathBuf, camera: Camera<IntrinsicsNorm>) -> Self {
        let (view_turn, poses_from) = (Orientation::NoTransforms, PosesFrom::default());
        Self { path, camera, undistortion: None, shape: None, mask: None, is_held_out: None, view_turn, poses_from }
    }

    pub fn read(&self) -> Result<Vec<u8>, DataError> {
        read_bounded(&self.path, MAX_IMAGE_BYTES, "reading an image")
    }

    /// Reads header and end of the image file, and the header of its mask, and checks the aspect ratios. Returns columns and rows
    /// of the turned image.
    pub fn header(&self) -> Result<([usize; 2], Turn), DataError> {
        let (stored, tag) = read_header(&self.path)?;
        let turn = self.turn(stored, tag)?;
        check_end(&self.path, MAX_IMAGE_BYTES)?;
        if let Some(path) = &self.mask {
            let reason = "whose mask cannot be used";
            let bad =
                |what: String| DataError::BadPhoto { reason, what: format!("bad mask: {what}"), path: path.clone() };
            let (size, _) = read_header(path).map_err(|error| bad(error.to_string()))?;
            check_mask_size(size, stored).map_err(bad)?;
        }
        let [width, height] = stored;
        let size = if exchanges(turn.pixels) || exchanges(turn.view) { [height, width] } else { stored };
        Ok((size, turn))
    }

    /// Checks the data of the file.
    pub fn check_data(&self) -> Result<(), DataError> {
        let damaged = |what: String| DataError::BadPhoto {
            reason: "whose image is damaged",
            what: format!("the image is damaged: {what}"),
            path: self.path.clone(),
        };
        check_image(&self.read()?).map_err(damaged)
    }

    /// Returns whether a mask or an alpha channel leaves pixels out.
    pub fn has_coverage(&self) -> bool {
        self.mask.is_some() || has_alpha(&self.path)
    }

    /// Decodes the image over a background, turns it to the orientation of its camera and undistorts it, and its coverage
    /// likewise (see [`SceneSource::frame_with_coverage`](crate::SceneSource::frame_with_coverage)). `least` are the columns and
    /// rows that the result must cover: a much larger image with lens distortion is reduced.
    pub fn decode(
        &self,
        background: [u8; 3],
        least: [usize; 2],
        key: &str,
        frame: usize,
    ) -> Result<(RgbImage, Option<RgbImage>), DataError> {
        let bytes = self.read()?;
        let (mut image, alpha) = decode_with_alpha(&bytes, key, frame)?;
        let stored = [image.width, image.height];
        let pixels = self.turn(stored, exif_orientation(&bytes))?.pixels;
        let mask = self.mask.as_ref().map(|mask| read_mask(mask, &image, key, frame)).transpose()?;
        let coverage = match (alpha, mask) {
            (Some(alpha), Some(mask)) => Some(alpha.iter().zip(mask).map(|(alpha, mask)| alpha & mask).collect()),
            (alpha, mask) => alpha.or(mask),
        };
        let coverage = coverage.map(|coverage: Vec<u8>| {
            for (pixel, share) in image.rgb.as_chunks_mut::<3>().0.iter_mut().zip(&coverage) {
                *pixel = blend(*pixel, background, *share);
            }
            RgbImage { rgb: coverage.into_iter().flat_map(|share| [share; 3]).collect(), ..image }
        });
        let prepare = |image: RgbImage| {
            let image = apply_orientation(image, pixels);
            let image = match &self.undistortion {
                Some(undistortion) => undistortion.apply(&self.reduced(image, least)),
                None => image,
            };
            apply_orientation(image, self.view_turn)
        };
        Ok((prepare(image), coverage.map(prepare)))
    }

    /// Reduces an image whose sides are more than [`UNDISTORTED_SCALE`] times those that its undistorted view must have.
    fn reduced(&self, image: RgbImage, [mut width, mut height]: [usize; 2]) -> RgbImage {
        if exchanges(self.view_turn) {
            (width, height) = (height, width);
        }
        let from = (image.width, image.height);
        let (width, height) = covering_size(from, (UNDISTORTED_SCALE * width, UNDISTORTED_SCALE * height));
        if width < from.0 && width * height > 0 { resize_lanczos(&image, width, height) } else { image }
    }

    /// Turns the camera, and on load the image, by an orientation that does not mirror.
    pub fn turn_view(&mut self, orientation: Orientation) {
        let IntrinsicsNorm { fx, fy, cx, cy } = self.camera.intrinsics;
        let (intrinsics, columns) = match orientation {
            Orientation::Rotate90 => ([fy, fx, 1.0 - cy, cx], [[0.0, -1.0], [1.0, 0.0]]),
            Orientation::Rotate180 => ([fx, fy, 1.0 - cx, 1.0 - cy], [[-1.0, 0.0], [0.0, -1.0]]),
            Orientation::Rotate270 => ([fy, fx, cy, 1.0 - cx], [[0.0, 1.0], [-1.0, 0.0]]),
            _ => return,
        };
        let [fx, fy, cx, cy] = intrinsics;
        let [right, down] = columns;
        self.camera.intrinsics = IntrinsicsNorm { fx, fy, cx, cy };
        let turn = DMat3::from_cols_array(&[right[0], right[1], 0.0, down[0], down[1], 0.0, 0.0, 0.0, 1.0]);
        self.camera.c2w.rotation *= turn;
        self.view_turn = orientation;
    }

    /// Returns whether stored pixels have the aspect ratio of the camera.
    fn fits(&self, [width, height]: [usize; 2]) -> bool {
        let shape = width as f64 / height as f64;
        self.shape.is_none_or(|expected| (shape / expected - 1.0).abs() <= MAX_SHAPE_ERROR)
    }

    /// Decides how the EXIF orientation `tag` is used, by the aspect ratio of the camera.
    fn turn(&self, stored: [usize; 2], tag: Orientation) -> Result<Turn, DataError> {
        let [width, height] = stored;
        let is_rotation = matches!(tag, Orientation::Rotate90 | Orientation::Rotate180 | Orientation::Rotate270);
        let fits_turned = self.fits(if exchanges(tag) { [height, width] } else { stored });
        match (self.fits(stored), fits_turned) {
            (true, true) if self.poses_from == PosesFrom::Turned => {
                return Ok(Turn { pixels: tag, is_undecided: is_rotation, ..Turn::NONE });
            }
            (true, _) if is_rotation => return Ok(Turn { view: tag, is_undecided: fits_turned, ..Turn::NONE }),
            (true, _) => return Ok(Turn::NONE),
            (false, true) => return Ok(Turn { pixels: tag, ..Turn::NONE }),
            (false, false) => {}
        }
        let what = format!(
            "the image is {width}x{height}, aspect ratio {:.3}, but its camera has {:.3}; the image may have been rotated or \
             cropped after the calibration",
            width as f64 / height as f64,
            self.shape.unwrap_or_default()
        );
        let reason = "whose image has another aspect ratio than its camera";
        Err(DataError::BadPhoto { reason, what, path: self.path.clone() })
    }
}

/// Returns whether an orientation exchanges columns and rows.
pub(crate) fn exchanges(orientation: Orientation) -> bool {
    orientation.to_exif() >= 5
}

/// Checks that a mask has the aspect ratio of its image, both as columns and rows.
fn check_mask_size(mask: [usize; 2], image: [usize; 2]) -> Result<(), String> {
    let error = (mask[0] * image[1]) as f64 / (mask[1] * image[0]) as f64 - 1.0;
    let what = || format!("{}x{} pixels, the image has {}x{}", mask[0], mask[1], image[0], image[1]);
    if error.abs() > MAX_SHAPE_ERROR { Err(what()) } else { Ok(()) }
}

/// Reads the mask of an image, `[height, width]`: 0 where the file is black, 255 elsewhere. Masks may be of another size.
fn read_mask(path: &Path, image: &RgbImage, key: &str, frame: usize) -> Result<Vec<u8>, DataError> {
    let bad = |what: String| DataError::BadScene {
        what: format!("mask of frame {frame} of {key}: {what}"),
        path: path.into(),
    };
    let bytes = read_bounded(path, MAX_IMAGE_BYTES, "reading a mask")?;
    let mut mask = decode_image(&bytes, key, frame).map_err(|error| bad(error.to_string()))?;
    // JPEG does not keep black exactly.
    let black = if image::guess_format(&bytes).is_ok_and(|format| format == ImageFormat::Jpeg) { 127 } else { 0 };
    mask.rgb.iter_mut().for_each(|value| *value = if *value > black { u8::MAX } else { 0 });
    let (from, to) = ([mask.width, mask.height], [image.width, image.height]);
    if from != to {
        check_mask_size(from, to).map_err(bad)?;
        mask = resize_lanczos(&mask, to[0], to[1]);
    }
    Ok(mask.rgb.as_chunks::<3>().0.iter().map(|pixel| pixel.iter().copied().fold(0, u8::max)).collect())
}

/// Returns a pixel over a background, at a share of 0 to 255.
fn blend(pixel: [u8; 3], background: [u8; 3], share: u8) -> [u8; 3] {
    let share = u32::from(share);
    std::array::from_fn(|i| {
        ((u32::from(pixel[i]) * share + u32::from(background[i]) * (255 - share) + 127) / 255) as u8
    })
}

impl PhotoScene {
    /// Gives each photo without a mask the file of its name in the folder `masks` (`masks_4` for images of `images_4`),
    /// with or without the ending of the image: `masks/a.jpg.png` (COLMAP) or `masks/a.png`.
    pub fn find_masks(&mut self, folder: &Path) {
        let mut folders: Vec<PathBuf> =
            ["", "_2", "_4", "_8"].map(|scaled| folder.join(format!("masks{scaled}"))).into();
        folders.retain(|masks| masks.is_dir());
        for photo in self.photos.iter_mut().filter(|photo| photo.mask.is_none() && !folders.is_empty()) {
            let Ok(below) = photo.path.strip_prefix(folder) else { continue };
            let first = below.iter().next().unwrap_or_default().to_string_lossy();
            let scaled = folder.join(first.replacen("images", "masks", 1));
            let below = if below.iter().count() > 1 { below.strip_prefix(&*first).unwrap_or(below) } else { below };
            let masks = folders.iter().find(|masks| **masks == scaled).or_else(|| folders.first());
            let beside = masks.unwrap_or(&scaled).join(below);
            let mut with_ending = beside.clone().into_os_string();
            with_ending.push(".png");
            let mut files = [PathBuf::from(with_ending), beside.with_extension("png"), beside].into_iter();
            photo.mask = files.find(|file| file.is_file());
        }
    }

    pub fn skip(&mut self, name: impl Into<String>, reason: impl Into<String>) {
        self.missing.push(MissingPhoto { name: name.into(), reason: reason.into() });
    }

    /// Returns the names of the frames: the paths of the images below the folder that holds all of them, with `/`.
    pub fn names(&self) -> Vec<String> {
        let mut common = self.photos.first().and_then(|photo| photo.path.parent()).unwrap_or(Path::new(""));
        while let Some(parent) = common.parent()
            && !self.photos.iter().all(|photo| photo.path.starts_with(common))
        {
            common = parent;
        }
        let name = |photo: &Photo| {
            let below = photo.path.strip_prefix(common).unwrap_or(&photo.path);
            below.iter().map(|part| decode_name(part.as_encoded_bytes())).collect::<Vec<_>>().join("/")
        };
        self.photos.iter().map(name).collect()
    }
}
