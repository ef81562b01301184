//! `transforms.json` of nerfstudio and instant-ngp: own captures and DL3DV.
//!
//! Poses are camera to world with OpenGL axes (+x right, +y up, -z forward) and are converted to OpenCV axes.

use std::collections::HashSet;
use std::fmt;
use std::marker::PhantomData;
use std::path::Path;

use clift_core::{Intrinsics, IntrinsicsNorm, Pose, folder_of};
use serde::de::{Error, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};

use crate::error::DataError;
use crate::files::bounded::{parse_json, read_bounded};
use crate::files::listing::natural_order;
use crate::geometry::lens::Lens;
use crate::image::codec::read_header;
use crate::sources::photos::image_locator::ImageLocator;
use crate::sources::photos::photo::{MAX_FRAMES, Photo, PhotoOptions, PhotoScene};

/// Largest size of a `transforms.json`, in bytes.
const MAX_BYTES: u64 = 128 << 20;
/// Longest name of an image, in bytes: the limit of operating systems for a path.
const MAX_NAME_BYTES: usize = 4096;

/// Largest number of distortion parameters of a camera: those of `FISHEYE624`.
const MAX_DISTORTION_PARAMS: usize = 12;

/// Defines a struct with the keys of a camera, which may occur at the top level and in a frame.
macro_rules! with_optics {
    ($name:ident { $($field:ident: $type:ty,)* }) => {
        #[derive(Deserialize)]
        struct $name {
            $($field: $type,)*
            camera_model: Option<String>,
            is_fisheye: Option<bool>,
            w: Option<f64>,
            h: Option<f64>,
            fl_x: Option<f64>,
            fl_y: Option<f64>,
            cx: Option<f64>,
            cy: Option<f64>,
            camera_angle_x: Option<f64>,
            camera_angle_y: Option<f64>,
            k1: Option<f64>,
            k2: Option<f64>,
            k3: Option<f64>,
            k4: Option<f64>,
            k5: Option<f64>,
            k6: Option<f64>,
            p1: Option<f64>,
            p2: Option<f64>,
            sx1: Option<f64>,
            sy1: Option<f64>,
            omega: Option<f64>,
            distortion_params: Option<Bounded<f64, MAX_DISTORTION_PARAMS>>,
        }

        impl $name {
            fn optics(&self) -> Optics<'_> {
                Optics {
                    camera_model: self.camera_model.as_deref(),
                    is_fisheye: self.is_fisheye,
                    size: [self.w, self.h],
                    focal: [self.fl_x, self.fl_y],
                    centre: [self.cx, self.cy],
                    angle: [self.camera_angle_x, self.camera_angle_y],
                    radial: [self.k1, self.k2, self.k3, self.k4, self.k5, self.k6],
                    tangential: [self.p1, self.p2],
                    prism: [self.sx1, self.sy1],
                    omega: self.omega,
                    distortion_params: self.distortion_params.as_ref().map(|list| list.0.as_slice()),
                }
            }
        }
    };
}

with_optics!(Document { frames: Bounded<Entry, MAX_FRAMES>, });
with_optics!(Entry { file_path: String, mask_path: Option<String>, transform_matrix: Bounded<[f64; 4], 4>, });

impl Entry {
    /// Returns the upper three rows of the matrix; the fourth is optional.
    fn c2w_rows(&self) -> Result<[[f64; 4]; 3], String> {
        let rows = &self.transform_matrix.0;
        if let Some(last) = rows.get(3) {
            let error = last.iter().zip([0.0, 0.0, 0.0, 1.0]).map(|(got, expected)| (got - expected).abs());
            if error.fold(0.0, f64::max) > 1e-6 {
                return Err(format!("transform_matrix ends in {last:?}, expected 0 0 0 1"));
            }
        }
        match rows.as_slice() {
            [a, b, c, ..] => Ok([*a, *b, *c]),
            rows => Err(format!("transform_matrix has {} rows, expected 4", rows.len())),
        }
    }
}

/// Camera keys of one level. Lengths are in pixels, angles in radians.
struct Optics<'a> {
    camera_model: Option<&'a str>,
    is_fisheye: Option<bool>,
    size: [Option<f64>; 2],
    focal: [Option<f64>; 2],
    centre: [Option<f64>; 2],
    angle: [Option<f64>; 2],
    radial: [Option<f64>; 6],
    tangential: [Option<f64>; 2],
    prism: [Option<f64>; 2],
    omega: Option<f64>,
    /// All distortion parameters of nerfstudio in one list, instead of the keys above.
    distortion_params: Option<&'a [f64]>,
}

impl<'a> Optics<'a> {
    /// Fills missing keys of a frame from the top level. A focal length of the frame overrides an angle of that level.
    fn or(self, top: &Optics<'a>) -> Self {
        let either = |own: [Option<f64>; 2], top: [Option<f64>; 2]| [own[0].or(top[0]), own[1].or(top[1])];
        let has_focal = self.focal.iter().chain(&self.angle).any(Option::is_some);
        Self {
            camera_model: self.camera_model.or(top.camera_model),
            is_fisheye: self.is_fisheye.or(top.is_fisheye),
            size: either(self.size, top.size),
            focal: if has_focal { self.focal } else { top.focal },
            angle: if has_focal { self.angle } else { top.angle },
            centre: either(self.centre, top.centre),
            radial: std::array::from_fn(|i| self.radial[i].or(top.radial[i])),
            tangential: either(self.tangential, top.tangential),
            prism: either(self.prism, top.prism),
            omega: self.omega.or(top.omega),
            distortion_params: self.distortion_params.or(top.distortion_params),
        }
    }

    /// Returns the lens of a nerfstudio or COLMAP model, its name in any case.
    fn lens(&self) -> Result<Lens, String> {
        const PERSPECTIVE: [&str; 6] =
            ["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"];
        const FISHEYE: [&str; 5] =
            ["OPENCV_FISHEYE", "FISHEYE", "SIMPLE_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"];
        const OTHERS: [&str; 5] =
            ["FULL_OPENCV", "FOV", "THIN_PRISM_FISHEYE", "FISHEYE624", "RAD_TAN_THIN_PRISM_FISHEYE"];
        let mut model = self.camera_model.unwrap_or("OPENCV").to_ascii_uppercase();
        let is_in = |models: &[&str], model: &str| models.contains(&model);
        if self.is_fisheye == Some(true) && is_in(&PERSPECTIVE, &model) {
            model = "OPENCV_FISHEYE".into();
        }
        let mut radial = self.radial.map(Option::unwrap_or_default);
        let mut tangential = self.tangential.map(Option::unwrap_or_default);
        let list = self.distortion_params.unwrap_or_default();
        let is_aria = is_in(&OTHERS[3..], &model);
        match *list {
            [k1, k2, k3, k4, p1, p2] if !is_aria => {
                (radial, tangential) = ([k1, k2, k3, k4, 0.0, 0.0], [p1, p2]);
            }
            [k1, k2, k3, k4] if !is_aria => radial = [k1, k2, k3, k4, 0.0, 0.0],
            _ if list.is_empty() != is_aria => {}
            _ => {
                let (count, expected) = (list.len(), if is_aria { "12" } else { "4 or 6" });
                return Err(format!("distortion_params has {count} numbers, expected {expected} for {model}"));
            }
        }
        let ([k1, k2, k3, k4, k5, k6], [p1, p2]) = (radial, tangential);
        let [sx, sy] = self.prism.map(Option::unwrap_or_default);
        let is_rational = k5 != 0.0 || k6 != 0.0;
        let lens = match model.as_str() {
            // nerfstudio's k4 is the coefficient of r^8, and OpenCV's one of a divisor.
            name if is_in(&PERSPECTIVE, name) && !is_rational => {
                Some(Lens { radial: [k1, k2, k3, k4, 0.0, 0.0], tangential, ..Lens::default() })
            }
            name if name == "FULL_OPENCV" || is_in(&PERSPECTIVE, name) => {
                Lens::from_colmap("FULL_OPENCV", &[k1, k2, p1, p2, k3, k4, k5, k6])
            }
            name if is_in(&FISHEYE, name) => Lens::from_colmap("OPENCV_FISHEYE", &[k1, k2, k3, k4]),
            "THIN_PRISM_FISHEYE" => Lens::from_colmap(&model, &[k1, k2, p1, p2, k3, k4, sx, sy]),
            "FOV" => Lens::from_colmap(&model, &[self.omega.ok_or("expected omega of the FOV camera")?]),
            _ if is_aria => Lens::from_colmap("RAD_TAN_THIN_PRISM_FISHEYE", list),
            _ => None,
        };
        let lens = lens.ok_or_else(|| {
            let given = self.camera_model.unwrap_or("OPENCV");
            let known = [&PERSPECTIVE[..], &FISHEYE, &OTHERS].concat().join(", ");
            format!("camera_model is {given}, expected one of {known}")
        })?;
        lens.validate().map(|()| lens).map_err(|error| error.to_string())
    }

    /// Returns columns and rows of the images to which the intrinsics apply.
    fn size(&self) -> Result<Option<[f64; 2]>, String> {
        let [Some(width), Some(height)] = self.size else { return Ok(None) };
        for (name, side) in [("w", width), ("h", height)] {
            if !(side.is_finite() && side >= 1.0) {
                return Err(format!("{name} is {side}, expected a number of pixels"));
            }
        }
        Ok(Some([width, height]))
    }

    fn intrinsics_norm(&self, [width, height]: [f64; 2]) -> Result<IntrinsicsNorm, String> {
        let from_angle = |axis: usize, side: f64| self.angle[axis].map(|angle| 0.5 * side / (0.5 * angle).tan());
        let [x, y] = [self.focal[0].or_else(|| from_angle(0, width)), self.focal[1].or_else(|| from_angle(1, height))];
        let (Some(fx), Some(fy)) = (x.or(y), y.or(x)) else {
            return Err("expected fl_x or camera_angle_x, found neither".into());
        };
        let [cx, cy] = self.centre;
        let intrinsics = Intrinsics { fx, fy, cx: cx.unwrap_or(width / 2.0), cy: cy.unwrap_or(height / 2.0) };
        let intrinsics_norm = IntrinsicsNorm::from_pixels(intrinsics, width, height);
        intrinsics_norm.validate().map(|()| intrinsics_norm).map_err(|error| error.to_string())
    }
}

/// Reads a `transforms.json` and locates its images. Frames are in the natural order of their names.
pub(crate) fn read_transforms(path: &Path, options: &PhotoOptions) -> Result<PhotoScene, DataError> {
    let bad = |what: String| DataError::BadScene { what, path: path.to_owned() };
    let text = read_bounded(path, MAX_BYTES, "reading the cameras")?;
    let document: Document = parse_json(&text).map_err(|error| bad(explain(&error, &text)))?;
    drop(text);
    let folder = folder_of(path);
    let mut entries: Vec<&Entry> = document.frames.0.iter().collect();
    if let Some(Entry { file_path: name, .. }) = entries.iter().find(|entry| entry.file_path.len() > MAX_NAME_BYTES) {
        let start: String = name.chars().take(40).collect();
        return Err(bad(format!("frame {start}..: its name has {} bytes, more than {MAX_NAME_BYTES}", name.len())));
    }
    entries.sort_by(|a, b| natural_order(&a.file_path, &b.file_path));
    let mut images = ImageLocator::new(folder, options);
    let (top, mut scene) = (document.optics(), PhotoScene::default());
    let mut used = HashSet::new();
    for entry in entries {
        let name = &entry.file_path;
        let in_frame = |what: String| bad(format!("frame {name}: {what}"));
        let image = match images.find(name) {
            Ok(image) if used.insert(image.clone()) => image,
            found => {
                scene.skip(name, found.map_or_else(|reason| reason, |_| "with the image of another frame".into()));
                continue;
            }
        };
        let mask = entry.mask_path.as_ref().map(|mask| folder.join(mask.replace('\\', "/")));
        if mask.as_ref().is_some_and(|mask| !mask.is_file()) {
            scene.skip(name, "without the mask of its mask_path");
            continue;
        }
        let optics = entry.optics().or(&top);
        let lens = optics.lens().map_err(in_frame)?;
        let given = optics.size().map_err(in_frame)?;
        let size = given.map_or_else(|| read_header(&image).map(|(size, _)| size.map(|side| side as f64)), Ok);
        let Ok(size) = size else {
            scene.skip(name, "whose image cannot be read");
            continue;
        };
        let intrinsics_norm = optics.intrinsics_norm(size).map_err(in_frame)?;
        let rows = entry.c2w_rows().map_err(in_frame)?;
        let photo = Pose::from_opengl(&rows)
            .map_err(DataError::from)
            .and_then(|c2w| Photo::new(image, c2w, intrinsics_norm, given, (lens, options.undistort)))
            .map_err(PhotoScene::in_frame(path, name))?;
        scene.photos.push(Photo { mask, ..photo });
    }
    scene.num_without_camera = images.num_unrequested();
    Ok(scene)
}

/// Returns the message of the parser, with a hint on NaN and infinite numbers, which Python writes and JSON does not have.
fn explain(error: &serde_json::Error, text: &[u8]) -> String {
    let line = text.split(|byte| *byte == b'\n').nth(error.line().saturating_sub(1)).unwrap_or_default();
    let column = error.column().min(line.len());
    let near = String::from_utf8_lossy(&line[column.saturating_sub(9)..line.len().min(column + 9)]);
    let hint = if near.contains("NaN") || near.contains("Infinity") { " (a number is NaN or infinite)" } else { "" };
    format!("expected the format of nerfstudio, got {error}{hint}")
}

/// A list of at most `MAX` items, because parsed JSON takes up to a hundred times the memory of its text.
struct Bounded<T, const MAX: usize>(Vec<T>);

impl<'de, T: Deserialize<'de>, const MAX: usize> Deserialize<'de> for Bounded<T, MAX> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_seq(BoundedVisitor(PhantomData))
    }
}

struct BoundedVisitor<T, const MAX: usize>(PhantomData<T>);

impl<'de, T: Deserialize<'de>, const MAX: usize> Visitor<'de> for BoundedVisitor<T, MAX> {
    type Value = Bounded<T, MAX>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "a list of at most {MAX}")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Self::Value, A::Error> {
        let mut list = Vec::new();
        while let Some(item) = items.next_element()? {
            if list.len() == MAX {
                return Err(A::Error::custom(format!("a list of more than {MAX} items")));
            }
            list.push(item);
        }
        Ok(Bounded(list))
    }
}
