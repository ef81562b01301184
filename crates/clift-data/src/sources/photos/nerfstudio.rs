//! `transforms.json` of nerfstudio and instant-ngp: own captures and DL3DV.
//!
//! Poses are camera to world with OpenGL axes (+x right, +y up, -z forward) and are converted to OpenCV axes.

use std::collections::HashSet;
use std::path::Path;

use clift_core::{Intrinsics, IntrinsicsNorm, Pose, folder_of};
use serde::Deserialize;
use serde_json::value::RawValue;

use crate::error::DataError;
use crate::files::bounded::read_bounded;
use crate::files::listing::natural_order;
use crate::geometry::lens::Lens;
use crate::geometry::scaled_rotation::{note_on_scales, unscaled};
use crate::image::codec::read_header;
use crate::skip_report::{first_few, plural};
use crate::sources::photos::image_locator::ImageLocator;
use crate::sources::photos::loose_json::{Bounded, Number, parse, values};
use crate::sources::photos::photo::{MAX_FRAMES, Photo, PhotoOptions, PhotoScene, exchanges, unusable};

/// Largest size of a `transforms.json`, in bytes.
const MAX_BYTES: u64 = 128 << 20;
/// Longest name of an image, in bytes: the limit of operating systems for a path.
const MAX_NAME_BYTES: usize = 4096;
/// Largest number of characters of a text of the file in a report.
const MAX_SHOWN_CHARS: usize = 256;

/// Smallest ratio of twice the principal point to the image at which the image counts as smaller than the calibration.
const MIN_CALIBRATED_SCALE: f64 = 1.5;
/// Largest share by which a principal point is off the image centre there.
const MAX_CENTRE_OFFSET: f64 = 0.1;
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
            w: Option<Number>,
            h: Option<Number>,
            fl_x: Option<Number>,
            fl_y: Option<Number>,
            cx: Option<Number>,
            cy: Option<Number>,
            camera_angle_x: Option<Number>,
            camera_angle_y: Option<Number>,
            k1: Option<Number>,
            k2: Option<Number>,
            k3: Option<Number>,
            k4: Option<Number>,
            k5: Option<Number>,
            k6: Option<Number>,
            p1: Option<Number>,
            p2: Option<Number>,
            sx1: Option<Number>,
            sy1: Option<Number>,
            omega: Option<Number>,
            distortion_params: Option<Bounded<Number, MAX_DISTORTION_PARAMS>>,
        }

        impl $name {
            fn optics(&self) -> Optics<'_> {
                Optics {
                    camera_model: self.camera_model.as_deref(),
                    is_fisheye: self.is_fisheye,
                    size: values([self.w, self.h]),
                    focal: values([self.fl_x, self.fl_y]),
                    centre: values([self.cx, self.cy]),
                    angle: values([self.camera_angle_x, self.camera_angle_y]),
                    radial: values([self.k1, self.k2, self.k3, self.k4, self.k5, self.k6]),
                    tangential: values([self.p1, self.p2]),
                    prism: values([self.sx1, self.sy1]),
                    omega: self.omega.map(|Number(value)| value),
                    distortion_params: self.distortion_params.as_ref().map(|list| list.0.as_slice()),
                }
            }
        }
    };
}

/// A list whose items are parsed one by one.
type Items = Bounded<Box<RawValue>, MAX_FRAMES>;

with_optics!(Document {
    frames: Items,
    train_filenames: Option<Items>,
    val_filenames: Option<Items>,
    test_filenames: Option<Items>,
});
with_optics!(Entry {
    file_path: String,
    mask_path: Option<String>,
    transform_matrix: Option<Bounded<[Number; 4], 4>>,
});

/// The name of a frame whose entry is malformed.
#[derive(Deserialize)]
struct EntryName {
    file_path: String,
}

impl Document {
    /// Returns the entries in the natural order of their names, and of those that are malformed the names and reasons.
    fn entries(&self) -> (Vec<Entry>, Vec<(String, String)>) {
        let (mut entries, mut malformed) = (Vec::new(), Vec::new());
        for (position, item) in self.frames.0.iter().enumerate() {
            let what = match serde_json::from_str::<Entry>(item.get()) {
                Ok(entry) if entry.file_path.len() <= MAX_NAME_BYTES => {
                    entries.push(entry);
                    continue;
                }
                Ok(entry) => format!("its name has {} bytes, more than {MAX_NAME_BYTES}", entry.file_path.len()),
                // Without the place, which counts from the start of the entry.
                Err(error) => {
                    let what = error.to_string();
                    what.rsplit_once(" at line ").map_or(what.as_str(), |(what, _)| what).to_owned()
                }
            };
            let name = serde_json::from_str(item.get()).map(|EntryName { file_path }| file_path);
            let name = name.unwrap_or_else(|_| format!("frames[{position}]"));
            malformed.push((shown(&name), format!("whose entry is malformed: {}", shown(&what))));
        }
        entries.sort_by(|a, b| natural_order(&a.file_path, &b.file_path));
        (entries, malformed)
    }

    /// Returns whether each of the frames of these names is held out of training: it is not in `train_filenames`, or is in
    /// `val_filenames` or `test_filenames`. `None` if these lists name no frame. Adds a note on names without a frame.
    fn held_out(&self, names: &[&str], notes: &mut Vec<String>) -> Option<Vec<bool>> {
        let names: Vec<String> = names.iter().map(|name| normal_path(name)).collect();
        let frames: HashSet<&str> = names.iter().map(String::as_str).collect();
        let mut unknown = Vec::new();
        let mut listed = |lists: &[&Option<Items>]| -> HashSet<String> {
            let items = lists.iter().copied().flatten().flat_map(|list| &list.0);
            let listed = items.filter_map(|item| serde_json::from_str::<String>(item.get()).ok());
            let (known, others): (Vec<_>, Vec<_>) =
                listed.map(|name| normal_path(&name)).partition(|name| frames.contains(name.as_str()));
            unknown.extend(others.iter().map(|name| shown(name)));
            known.into_iter().collect()
        };
        let train = listed(&[&self.train_filenames]);
        let held_out = listed(&[&self.val_filenames, &self.test_filenames]);
        if !unknown.is_empty() {
            let count = plural(unknown.len(), "name");
            notes.push(format!("{count} in the lists of file names without a frame ({})", first_few(&unknown)));
        }
        let is_held_out =
            |name: &String| if train.is_empty() { held_out.contains(name) } else { !train.contains(name) };
        (!(train.is_empty() && held_out.is_empty())).then(|| names.iter().map(is_held_out).collect())
    }
}

/// Returns the start of a text for a report.
fn shown(text: &str) -> String {
    text.chars().take(MAX_SHOWN_CHARS).collect()
}

/// Returns a path with the separator `/` and without `.`.
fn normal_path(path: &str) -> String {
    path.split(['/', '\\']).filter(|part| !["", "."].contains(part)).collect::<Vec<_>>().join("/")
}

impl Entry {
    /// Returns the camera-to-world pose, and the scale of the matrix if it was divided out.
    fn pose(&self) -> Result<(Pose, Option<f64>), String> {
        let rows = self.c2w_rows()?;
        let (rows, scale) = unscaled(rows);
        Pose::from_opengl(&rows).map(|pose| (pose, scale)).map_err(|error| error.to_string())
    }

    /// Returns the upper three rows of the matrix; the fourth is optional.
    fn c2w_rows(&self) -> Result<[[f64; 4]; 3], String> {
        let rows = self.transform_matrix.as_ref().ok_or("no transform_matrix")?;
        let rows: Vec<[f64; 4]> = rows.0.iter().map(|row| row.each_ref().map(|number| number.0)).collect();
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
    distortion_params: Option<&'a [Number]>,
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
        let list: Vec<f64> = self.distortion_params.unwrap_or_default().iter().map(|number| number.0).collect();
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
            _ if is_aria => Lens::from_colmap("RAD_TAN_THIN_PRISM_FISHEYE", &list),
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

    /// Returns which size an image of `stored` pixels had when the poses were computed, stored or turned by a quarter, where
    /// only one has the principal point near its centre.
    fn decided_size(&self, [width, height]: [usize; 2]) -> Option<[usize; 2]> {
        let [Some(cx), Some(cy)] = self.centre else { return None };
        let is_near = |&[x, y]: &[usize; 2]| (cx * y as f64 / (cy * x as f64) - 1.0).abs() <= MAX_CENTRE_OFFSET;
        let mut near = [[width, height], [height, width]].into_iter().filter(is_near);
        near.next().filter(|_| near.next().is_none())
    }

    /// Returns the size of the images to which the intrinsics apply where it is not given and images of `size` pixels are
    /// smaller: twice the principal point, as the nearest multiple of `size`.
    fn calibrated_size(&self, size: [f64; 2]) -> Option<[f64; 2]> {
        let ([Some(cx), Some(cy)], [Some(_), _] | [_, Some(_)]) = (self.centre, self.focal) else { return None };
        let [x, y] = [2.0 * cx / size[0], 2.0 * cy / size[1]];
        let scale = 0.5 * (x + y);
        if !scale.is_finite() || scale < MIN_CALIBRATED_SCALE || (x / y - 1.0).abs() > MAX_CENTRE_OFFSET {
            return None;
        }
        let multiple = scale.round();
        let scale = if (scale / multiple - 1.0).abs() < MAX_CENTRE_OFFSET { multiple } else { scale };
        Some(size.map(|side| side * scale))
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
    let document: Document =
        parse(&text).map_err(|error| bad(format!("expected the format of nerfstudio, got {error}")))?;
    drop(text);
    let folder = folder_of(path);
    let (entries, malformed) = document.entries();
    let mut images = ImageLocator::new(folder, options);
    let (top, mut scene) = (document.optics(), PhotoScene::default());
    for (name, reason) in malformed {
        scene.skip(name, reason);
    }
    let names: Vec<&str> = entries.iter().map(|entry| entry.file_path.as_str()).collect();
    let held_out = document.held_out(&names, &mut scene.notes);
    let (mut used, mut scales, mut num_guessed) = (HashSet::new(), Vec::new(), (0, [0.0; 2]));
    for (position, entry) in entries.iter().enumerate() {
        let name = &entry.file_path;
        let found = images.find(name).and_then(|image| {
            if used.insert(image.clone()) { Ok(image) } else { Err("with the image of another frame".into()) }
        });
        let photo = found.and_then(|image| {
            let mask = entry.mask_path.as_ref().map(|mask| folder.join(mask.replace('\\', "/")));
            if mask.as_ref().is_some_and(|mask| !mask.is_file()) {
                return Err("without the mask of its mask_path".to_owned());
            }
            let optics = entry.optics().or(&top);
            let lens = optics.lens().map_err(|what| unusable(&what))?;
            let mut given = optics.size().map_err(|what| unusable(&what))?;
            let size = if let Some(size) = given {
                size
            } else {
                let (stored, tag) = read_header(&image).map_err(|_| "whose image cannot be read".to_owned())?;
                let decided = if exchanges(tag) { optics.decided_size(stored) } else { None };
                let size = decided.unwrap_or(options.size_of_poses(stored, tag)).map(|side| side as f64);
                given = optics.calibrated_size(size);
                num_guessed = given.map_or(num_guessed, |guess| (num_guessed.0 + 1, guess));
                given = given.or(decided.map(|_| size));
                given.unwrap_or(size)
            };
            let intrinsics_norm = optics.intrinsics_norm(size).map_err(|what| unusable(&what))?;
            let (c2w, scale) = entry.pose().map_err(|what| unusable(&what))?;
            scales.extend(scale);
            let photo = Photo::new(image, c2w, intrinsics_norm, given, (lens, options.undistort));
            photo.map(|photo| Photo { mask, ..photo }).map_err(|error| unusable(&error))
        });
        match photo {
            Ok(photo) => {
                let is_held_out = held_out.as_ref().map(|held_out| held_out[position]);
                scene.photos.push(Photo { is_held_out, ..photo });
            }
            Err(reason) => scene.skip(name, reason),
        }
    }
    if held_out.is_some() {
        let count = scene.photos.iter().filter(|photo| photo.is_held_out == Some(true)).count();
        let of = plural(scene.photos.len(), "frame");
        scene.notes.push(format!("{count} of {of} held out by the lists of file names in {}", path.display()));
    }
    scene.notes.extend(note_on_scales(scales.into_iter(), path));
    if num_guessed.0 > 0 {
        let (count, [width, height]) = num_guessed;
        scene.notes.push(format!(
            "{} without w and h in {}, smaller than their principal point says: the intrinsics are taken as those of \
             images of {width:.0}x{height:.0}; write w and h",
            plural(count, "image"),
            path.display()
        ));
    }
    scene.num_without_camera = images.num_unrequested();
    Ok(scene)
}
