//! A picture file with its camera, and a scene of them: what every layout of one file per frame is read to.

use std::path::{Path, PathBuf};

use crate::error::DataError;
use crate::files::bounded::read_bounded;
use crate::geometry::camera::{Camera, IntrinsicsNorm};
use crate::geometry::lens::Lens;
use crate::geometry::pose::Pose;
use crate::image::codec::{check_end, decode, exif_orientation, read_size};
use crate::image::rgb_image::RgbImage;
use crate::image::undistort::Undistortion;

/// Most frames of one scene.
pub(crate) const MAX_FRAMES: usize = 100_000;
/// Most bytes of one picture file.
const MAX_PICTURE_BYTES: u64 = 256 << 20;
/// By how much the shape (width over height) of a picture may differ from that of its camera: rounding of a picture
/// scaled down to a few dozen pixels.
const MAX_SHAPE_ERROR: f64 = 0.02;

/// How photos are found and what is done to them.
#[derive(Clone, Debug, Default)]
pub(crate) struct PhotoOptions {
    /// Folder of the pictures, beside the cameras' file, instead of the one that it names.
    pub image_folder: Option<String>,
    /// Folders to look for when none is asked for, before the one that the cameras' file names.
    pub first_folders: &'static [&'static str],
    /// Whether lens distortion is undone; otherwise it is ignored.
    pub undistort: bool,
}

/// One picture on disk.
#[derive(Clone, Debug)]
pub(crate) struct Photo {
    pub path: PathBuf,
    /// The camera of the picture as it is given out: a pinhole.
    pub camera: Camera,
    /// How the file's picture becomes that.
    pub undistortion: Option<Box<Undistortion>>,
    /// Width over height of the pictures that the intrinsics were given for.
    pub shape: Option<f64>,
    /// Microseconds, or the number at the end of the file's name.
    pub time: Option<i64>,
}

/// A frame that has no photo, by the name its file gives it.
pub(crate) struct MissingPhoto {
    pub name: String,
    /// Why, in words that equal cases share.
    pub reason: String,
}

/// The photos of a scene, in the order of their frames.
#[derive(Default)]
pub(crate) struct PhotoScene {
    pub photos: Vec<Photo>,
    pub missing: Vec<MissingPhoto>,
    /// Pictures beside those of the frames that no camera is given for.
    pub num_without_camera: usize,
    /// What else is to be known.
    pub notes: Vec<String>,
    /// Where it comes from; empty if nothing says.
    pub url: String,
}

impl Photo {
    /// A photo through `lens`, which is undone on load if `undistort` says so and ignored otherwise.
    ///
    /// # Errors
    /// [`DataError::BadCamera`] for intrinsics that cannot be, and what [`Undistortion::new`] gives.
    pub fn new(
        path: PathBuf,
        c2w: Pose,
        intrinsics_norm: IntrinsicsNorm,
        lens: Lens,
        undistort: bool,
    ) -> Result<Self, DataError> {
        intrinsics_norm.validate()?;
        let time = number_at_end(&path);
        if !undistort || lens.is_pinhole() {
            let camera = Camera { intrinsics_norm, c2w };
            return Ok(Self { path, camera, undistortion: None, shape: None, time });
        }
        let undistortion = Undistortion::new(intrinsics_norm, lens)?;
        let camera = Camera { intrinsics_norm: undistortion.intrinsics_norm(), c2w };
        Ok(Self { path, camera, undistortion: Some(Box::new(undistortion)), shape: None, time })
    }

    /// Reads the file as it is.
    pub fn read(&self) -> Result<Vec<u8>, DataError> {
        read_bounded(&self.path, MAX_PICTURE_BYTES, "reading a picture")
    }

    /// Columns and rows, from the head of the file; its end is looked for as well.
    pub fn size(&self) -> Result<[usize; 2], DataError> {
        let size = read_size(&self.path)?;
        self.check_shape(size).map_err(|error| match (error, exif_orientation(&self.path)) {
            (DataError::BadScene { what, path }, Some(orientation)) => {
                let what = format!(
                    "{what}; its EXIF orientation is {orientation}, which is not applied, because cameras belong to \
                     the pixels as they are stored"
                );
                DataError::BadScene { what, path }
            }
            (error, _) => error,
        })?;
        check_end(&self.path, MAX_PICTURE_BYTES)?;
        Ok(size)
    }

    /// Decodes the picture and undoes the lens.
    pub fn decode(&self, key: &str, frame: usize) -> Result<RgbImage, DataError> {
        let picture = decode(&self.read()?, key, frame)?;
        self.check_shape([picture.width, picture.height])?;
        Ok(match &self.undistortion {
            Some(undistortion) => undistortion.apply(&picture),
            None => picture,
        })
    }

    /// A picture that was turned after its camera was found has the wrong camera.
    fn check_shape(&self, [width, height]: [usize; 2]) -> Result<(), DataError> {
        let Some(expected) = self.shape else { return Ok(()) };
        let shape = width as f64 / height as f64;
        if (shape / expected - 1.0).abs() <= MAX_SHAPE_ERROR {
            return Ok(());
        }
        let what = format!(
            "the picture is {width}x{height}, {shape:.3} times as wide as high, and its camera's {expected:.3} times; \
             it may have been turned or cropped after the cameras were found"
        );
        Err(DataError::BadScene { what, path: self.path.clone() })
    }
}

/// The digits that a file's name ends in: 12 of `frame_00012.png`.
fn number_at_end(path: &Path) -> Option<i64> {
    let stem = path.file_stem()?.to_str()?;
    let start = stem.rfind(|c: char| !c.is_ascii_digit()).map_or(0, |last| last + 1);
    stem.get(start..)?.parse().ok()
}

impl PhotoScene {
    /// Time stamps that rise from frame to frame; positions where names give none.
    pub fn timestamps(&self) -> Vec<i64> {
        let times: Option<Vec<i64>> = self.photos.iter().map(|photo| photo.time).collect();
        let times = times.filter(|times| times.is_sorted_by(|a, b| a < b));
        times.unwrap_or_else(|| (0..self.photos.len() as i64).collect())
    }

    /// An error about a frame of the scene at `path`.
    pub fn in_frame(path: &Path, name: &str) -> impl FnOnce(DataError) -> DataError {
        move |error| DataError::BadScene { what: format!("frame {name}: {error}"), path: path.to_owned() }
    }
}
