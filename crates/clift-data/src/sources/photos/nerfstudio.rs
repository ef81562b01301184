//! `transforms.json` of nerfstudio and instant-ngp: own captures and DL3DV.
//!
//! Poses are camera to world with OpenGL axes (+x right, +y up, -z forward) and are converted to OpenCV axes.

use std::collections::HashSet;
use std::fmt;
use std::marker::PhantomData;
use std::path::Path;

use clift_core::{DVec3, Intrinsics, IntrinsicsNorm, Pose, folder_of};
use serde::de::{Error, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};

use crate::error::DataError;
use crate::files::bounded::{parse_json, read_bounded};
use crate::files::listing::natural_order;
use crate::geometry::lens::Lens;
use crate::image::codec::read_header;
use crate::skip_report::plural;
use crate::sources::photos::image_locator::ImageLocator;
use crate::sources::photos::photo::{MAX_FRAMES, Photo, PhotoOptions, PhotoScene, unusable};

/// Largest size of a `transforms.json`, in bytes.
const MAX_BYTES: u64 = 128 << 20;
/// Longest name of an image, in bytes: the limit of operating systems for a path.
const MAX_NAME_BYTES: usize = 4096;

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

with_optics!(Document {
    frames: Bounded<Entry, MAX_FRAMES>,
    train_filenames: Option<Bounded<String, MAX_FRAMES>>,
    val_filenames: Option<Bounded<String, MAX_FRAMES>>,
    test_filenames: Option<Bounded<String, MAX_FRAMES>>,
});
with_optics!(Entry {
    file_path: String,
    mask_path: Option<String>,
    transform_matrix: Option<Bounded<[Number; 4], 4>>,
});

impl Document {
    /// Returns which frames the file holds out of training: those that are not in `train_filenames`, or those in
    /// `val_filenames` and `test_filenames`; `None` without such lists.
    fn held_out(&self) -> Option<impl Fn(&str) -> bool> {
        let names = |list: &'_ Option<Bounded<String, MAX_FRAMES>>| -> HashSet<String> {
            list.iter().flat_map(|list| &list.0).cloned().collect()
        };
        let train = names(&self.train_filenames);
        let held_out = &names(&self.val_filenames) | &names(&self.test_filenames);
        let has_list = !(train.is_empty() && held_out.is_empty());
        has_list
            .then_some(move |name: &str| if train.is_empty() { held_out.contains(name) } else { !train.contains(name) })
    }
}

impl Entry {
    /// Returns the camera-to-world pose, and the scale of the matrix if it was divided out.
    fn pose(&self) -> Result<(Pose, Option<f64>), String> {
        let rows = self.c2w_rows()?;
        let error = match Pose::from_opengl(&rows) {
            Ok(pose) => return Ok((pose, None)),
            Err(error) => error.to_string(),
        };
        let [x, y, z] = rows.map(|[a, b, c, _]| DVec3::new(a, b, c));
        let scale = x.dot(y.cross(z)).cbrt();
        let scaled = rows.map(|[a, b, c, t]| [a / scale, b / scale, c / scale, t]);
        let pose = Some(scale).filter(|scale| *scale > 0.0).and_then(|_| Pose::from_opengl(&scaled).ok());
        pose.map(|pose| (pose, Some(scale))).ok_or(error)
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
    let mut entries: Vec<&Entry> = document.frames.0.iter().collect();
    if let Some(Entry { file_path: name, .. }) = entries.iter().find(|entry| entry.file_path.len() > MAX_NAME_BYTES) {
        let start: String = name.chars().take(40).collect();
        return Err(bad(format!("frame {start}..: its name has {} bytes, more than {MAX_NAME_BYTES}", name.len())));
    }
    entries.sort_by(|a, b| natural_order(&a.file_path, &b.file_path));
    let mut images = ImageLocator::new(folder, options);
    let (top, mut scene) = (document.optics(), PhotoScene::default());
    let held_out = document.held_out();
    let (mut used, mut num_scaled, mut num_guessed) = (HashSet::new(), (0, 0.0), (0, [0.0; 2]));
    for entry in entries {
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
                let size = options.size_of_poses(stored, tag).map(|side| side as f64);
                given = optics.calibrated_size(size);
                num_guessed = given.map_or(num_guessed, |guess| (num_guessed.0 + 1, guess));
                given.unwrap_or(size)
            };
            let intrinsics_norm = optics.intrinsics_norm(size).map_err(|what| unusable(&what))?;
            let (c2w, scale) = entry.pose().map_err(|what| unusable(&what))?;
            num_scaled = scale.map_or(num_scaled, |scale| (num_scaled.0 + 1, scale));
            let photo = Photo::new(image, c2w, intrinsics_norm, given, (lens, options.undistort));
            photo.map(|photo| Photo { mask, ..photo }).map_err(|error| unusable(&error))
        });
        match photo {
            Ok(photo) => {
                let is_held_out = held_out.as_ref().map(|is_held_out| is_held_out(name));
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
    if num_scaled.0 > 0 {
        scene.notes.push(format!(
            "{} with a scaled rotation in {}: the scale, {:.3}, was divided out",
            plural(num_scaled.0, "frame"),
            path.display(),
            num_scaled.1
        ));
    }
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

/// Parses a document. Python and C++ write NaN and infinite numbers, which JSON does not have.
fn parse(text: &[u8]) -> Result<Document, serde_json::Error> {
    parse_json(text).or_else(|error| parse_json(&with_quoted_numbers(text).ok_or(error)?))
}

/// Returns JSON text with words such as `NaN`, `-Infinity` and `-nan(ind)` in quotes; `None` without such words.
fn with_quoted_numbers(text: &[u8]) -> Option<Vec<u8>> {
    let (mut quoted, mut is_string, mut at, mut has_words) = (Vec::with_capacity(text.len() + 64), false, 0, false);
    while let Some(&byte) = text.get(at) {
        let is_part = |byte: &u8| byte.is_ascii_alphanumeric() || b"+-.()#_".contains(byte);
        let length = if is_string { 0 } else { text[at..].iter().take_while(|byte| is_part(byte)).count() };
        let word = &text[at..at + length];
        let lower = word.iter().take(16).map(u8::to_ascii_lowercase).collect::<Vec<u8>>();
        if [&b"nan"[..], b"inf", b"#ind", b"#qnan"].iter().any(|part| lower.windows(part.len()).any(|w| w == *part)) {
            quoted.extend([b"\"", word, b"\""].concat());
            has_words = true;
        } else if length > 0 {
            quoted.extend(word);
        } else {
            let length = if is_string && byte == b'\\' { 2 } else { 1 };
            is_string ^= byte == b'"';
            quoted.extend(text[at..].iter().take(length));
            at += length;
        }
        at += word.len();
    }
    has_words.then_some(quoted)
}

/// A number, NaN for null and for the text of [`with_quoted_numbers`].
#[derive(Clone, Copy)]
struct Number(f64);

impl<'de> Deserialize<'de> for Number {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(NumberVisitor)
    }
}

struct NumberVisitor;

impl Visitor<'_> for NumberVisitor {
    type Value = Number;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a number")
    }

    fn visit_f64<E>(self, value: f64) -> Result<Number, E> {
        Ok(Number(value))
    }

    fn visit_i64<E>(self, value: i64) -> Result<Number, E> {
        Ok(Number(value as f64))
    }

    fn visit_u64<E>(self, value: u64) -> Result<Number, E> {
        Ok(Number(value as f64))
    }

    fn visit_str<E: Error>(self, text: &str) -> Result<Number, E> {
        Ok(Number(text.parse().unwrap_or(f64::NAN)))
    }

    fn visit_unit<E>(self) -> Result<Number, E> {
        Ok(Number(f64::NAN))
    }
}

fn values<const N: usize>(numbers: [Option<Number>; N]) -> [Option<f64>; N] {
    numbers.map(|number| number.map(|Number(value)| value))
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
