//! `transforms.json` of nerfstudio and instant-ngp: own captures and DL3DV.
//!
//! Poses are camera to world with OpenGL axes (+x right, +y up, -z forward) and are converted to OpenCV axes.

use std::collections::{BTreeMap, HashSet};
use std::path::Path;

use clift_core::{Intrinsics, IntrinsicsNorm, Pose, first_few, folder_of, plural};
use serde::Deserialize;
use serde::de::IgnoredAny;
use serde_json::value::RawValue;

use crate::error::DataError;
use crate::files::bounded::{parse_json, read_bounded};
use crate::files::listing::natural_order;
use crate::geometry::lens::Lens;
use crate::geometry::scaled_rotation::{note_on_scales, unscaled};
use crate::image::codec::read_header;
use crate::sources::photos::image_locator::ImageLocator;
use crate::sources::photos::photo::{MAX_FRAMES, Photo, PhotoOptions, PhotoScene, PosesFrom, exchanges, unusable};

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
/// Keys of the focal lengths in pixels and of the fields of view in radians.
const FOCAL: [&str; 4] = ["fl_x", "fl_y", "camera_angle_x", "camera_angle_y"];

/// The keys of one level of the file with unparsed values.
type Keys<'a> = BTreeMap<String, &'a RawValue>;

/// Returns JSON text in which the words of Python and C++ for NaN and infinite numbers, such as `NaN`, `-inf` and
/// `-nan(ind)`, are a number out of range: an error of the frame that has it.
fn mended(text: &[u8]) -> Vec<u8> {
    let (mut mended, mut is_string, mut at) = (Vec::with_capacity(text.len() + 64), false, 0);
    while let Some(&byte) = text.get(at) {
        let is_part = |byte: &&u8| byte.is_ascii_alphanumeric() || b"+-.()#_".contains(byte);
        let length = if is_string { 0 } else { text[at..].iter().take_while(is_part).count() };
        let lower = text[at..at + length].iter().take(16).map(u8::to_ascii_lowercase).collect::<Vec<u8>>();
        if [&b"nan"[..], b"inf", b"#ind", b"#qnan"].iter().any(|part| lower.windows(part.len()).any(|w| w == *part)) {
            mended.extend(b"1e999");
            at += length;
        } else {
            let length = length.max(if is_string && byte == b'\\' { 2 } else { 1 });
            is_string ^= byte == b'"';
            mended.extend(text[at..].iter().take(length));
            at += length;
        }
    }
    mended
}

/// Returns the start of a text for a report.
fn shown(text: &str) -> String {
    text.chars().take(MAX_SHOWN_CHARS).collect()
}

/// Returns an error of a value without its place, which counts from the start of the value.
fn of_value(error: &serde_json::Error) -> String {
    let what = error.to_string();
    shown(what.rsplit_once(" at line ").map_or(what.as_str(), |(what, _)| what))
}

/// A frame, with the keys of the top level for those that it lacks.
struct Frame<'a> {
    name: String,
    keys: Keys<'a>,
    top: &'a Keys<'a>,
}

impl<'a> Frame<'a> {
    /// Parses the entry of a frame.
    ///
    /// # Errors
    /// The name of the frame, as far as it has one, and the reason.
    fn parse(item: &'a RawValue, top: &'a Keys<'a>) -> Result<Self, (Option<String>, String)> {
        let keys: Keys<'a> = serde_json::from_str(item.get()).map_err(|error| (None, of_value(&error)))?;
        let name = keys.get("file_path").ok_or((None, "missing field `file_path`".to_owned()))?;
        let name: String = serde_json::from_str(name.get()).map_err(|error| (None, of_value(&error)))?;
        if name.len() > MAX_NAME_BYTES {
            let what = format!("its name has {} bytes, more than {MAX_NAME_BYTES}", name.len());
            return Err((Some(shown(&name)), what));
        }
        Ok(Self { name, keys, top })
    }

    /// Returns the value of a key; `None` for a missing or null one. A focal length of the frame overrides an angle of the top
    /// level.
    fn value<T: Deserialize<'a>>(&self, key: &str) -> Result<Option<T>, String> {
        let given = |keys: &Keys<'a>, key: &str| keys.get(key).copied().filter(|value| value.get() != "null");
        let has_focal = FOCAL.contains(&key) && FOCAL.iter().any(|key| given(&self.keys, key).is_some());
        let value = given(&self.keys, key).or_else(|| if has_focal { None } else { given(self.top, key) });
        let malformed = |error: serde_json::Error| format!("whose entry is malformed: {} in `{key}`", of_value(&error));
        value.map(|value| serde_json::from_str(value.get())).transpose().map_err(malformed)
    }

    fn numbers<const N: usize>(&self, keys: [&str; N]) -> Result<[Option<f64>; N], String> {
        let mut numbers = [None; N];
        for (number, key) in numbers.iter_mut().zip(keys) {
            *number = self.value(key)?;
        }
        Ok(numbers)
    }

    /// Returns the camera-to-world pose, and the scale of the matrix if it was divided out. The fourth row is optional.
    fn pose(&self) -> Result<(Pose, Option<f64>), String> {
        let rows: Option<Vec<[f64; 4]>> = self.value("transform_matrix")?;
        let rows = rows.ok_or_else(|| unusable(&"no transform_matrix"))?;
        let is_off =
            |last: &[f64; 4]| last.iter().zip([0.0, 0.0, 0.0, 1.0]).any(|(got, want)| (got - want).abs() > 1e-6);
        let upper = match rows[..] {
            [_, _, _, last] if is_off(&last) => {
                return Err(unusable(&format!("transform_matrix ends in {last:?}, expected 0 0 0 1")));
            }
            [a, b, c] | [a, b, c, _] => [a, b, c],
            _ => return Err(unusable(&format!("transform_matrix has {} rows, expected 4", rows.len()))),
        };
        let (rows, scale) = unscaled(upper);
        Pose::from_opengl(&rows).map(|pose| (pose, scale)).map_err(|error| unusable(&error))
    }

    /// Returns the lens of a nerfstudio or COLMAP model, its name in any case.
    fn lens(&self) -> Result<Lens, String> {
        const PERSPECTIVE: [&str; 6] =
            ["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"];
        const FISHEYE: [&str; 5] =
            ["OPENCV_FISHEYE", "FISHEYE", "SIMPLE_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"];
        const OTHERS: [&str; 2] = ["FULL_OPENCV", "THIN_PRISM_FISHEYE"];
        let given: String = self.value("camera_model")?.unwrap_or_else(|| "OPENCV".into());
        let mut model = given.to_ascii_uppercase();
        if self.value("is_fisheye")? == Some(true) && PERSPECTIVE.contains(&model.as_str()) {
            model = "OPENCV_FISHEYE".into();
        }
        let or_zero = Option::unwrap_or_default;
        let [k1, k2, k3, k4, k5, k6] = self.numbers(["k1", "k2", "k3", "k4", "k5", "k6"])?.map(or_zero);
        let [p1, p2, sx, sy] = self.numbers(["p1", "p2", "sx1", "sy1"])?.map(or_zero);
        // The distortion parameters of nerfstudio in one list, instead of the keys above.
        let list: Vec<f64> = self.value("distortion_params")?.unwrap_or_default();
        let (radial, tangential) = match *list {
            [] => ([k1, k2, k3, k4], [p1, p2]),
            [k1, k2, k3, k4] => ([k1, k2, k3, k4], [p1, p2]),
            [k1, k2, k3, k4, p1, p2] => ([k1, k2, k3, k4], [p1, p2]),
            _ => {
                let what = format!("distortion_params has {} numbers, expected 4 or 6 for {model}", list.len());
                return Err(unusable(&what));
            }
        };
        let ([k1, k2, k3, k4], [p1, p2]) = (radial, tangential);
        let is_rational = k5 != 0.0 || k6 != 0.0;
        let lens = match model.as_str() {
            // nerfstudio's k4 is the coefficient of r^8, and OpenCV's one of a divisor.
            name if PERSPECTIVE.contains(&name) && !is_rational => Some(Lens { radial, tangential, ..Lens::default() }),
            name if name == "FULL_OPENCV" || PERSPECTIVE.contains(&name) => {
                Lens::from_colmap("FULL_OPENCV", &[k1, k2, p1, p2, k3, k4, k5, k6])
            }
            name if FISHEYE.contains(&name) => Lens::from_colmap("OPENCV_FISHEYE", &radial),
            "THIN_PRISM_FISHEYE" => Lens::from_colmap(&model, &[k1, k2, p1, p2, k3, k4, sx, sy]),
            _ => None,
        };
        let lens = lens.ok_or_else(|| {
            let known = [&PERSPECTIVE[..], &FISHEYE, &OTHERS].concat().join(", ");
            unusable(&format!("camera_model is {given}, expected one of {known}"))
        })?;
        lens.validate().map(|()| lens).map_err(|error| unusable(&error))
    }

    /// Returns columns and rows of the images to which the intrinsics apply; `None` if they are not given.
    fn size(&self) -> Result<Option<[f64; 2]>, String> {
        let [Some(width), Some(height)] = self.numbers(["w", "h"])? else { return Ok(None) };
        for (name, side) in [("w", width), ("h", height)] {
            if side < 1.0 {
                return Err(unusable(&format!("{name} is {side}, expected a number of pixels")));
            }
        }
        Ok(Some([width, height]))
    }

    /// Guesses the size of the images that were calibrated, from the principal point, which is near their centre. Returns
    /// `None` if there is no principal point or it decides nothing, and whether the calibrated images were much larger.
    ///
    /// `[width, height]` is the size of the stored image, and `assumed` the size at which the poses were computed. The guess may
    /// be the size of the rotated image if the EXIF orientation `exchanges` its sides. Of much larger images it is a multiple.
    fn guessed_size(
        &self,
        [width, height]: [f64; 2],
        assumed: [f64; 2],
        exchanges: bool,
    ) -> Result<(Option<[f64; 2]>, bool), String> {
        let [Some(cx), Some(cy)] = self.numbers(["cx", "cy"])? else { return Ok((None, false)) };
        let is_near = |&[x, y]: &[f64; 2]| (cx * y / (cy * x) - 1.0).abs() <= MAX_CENTRE_OFFSET;
        let mut near = [[width, height], [height, width]].into_iter().filter(is_near);
        let decided = near.next().filter(|_| exchanges && near.next().is_none());
        let size = decided.unwrap_or(assumed);
        let [x, y] = [2.0 * cx / size[0], 2.0 * cy / size[1]];
        let (scale, [fl_x, fl_y]) = (0.5 * (x + y), self.numbers(["fl_x", "fl_y"])?);
        let is_larger = scale.is_finite() && scale >= MIN_CALIBRATED_SCALE && (x / y - 1.0).abs() <= MAX_CENTRE_OFFSET;
        if !is_larger || fl_x.or(fl_y).is_none() {
            return Ok((decided, false));
        }
        let multiple = scale.round();
        let scale = if (scale / multiple - 1.0).abs() < MAX_CENTRE_OFFSET { multiple } else { scale };
        Ok((Some(size.map(|side| side * scale)), true))
    }

    fn intrinsics_norm(&self, [width, height]: [f64; 2]) -> Result<IntrinsicsNorm, String> {
        let [fl_x, fl_y, angle_x, angle_y] = self.numbers(FOCAL)?;
        let of_angle = |angle: Option<f64>, side: f64| angle.map(|angle| 0.5 * side / (0.5 * angle).tan());
        let [x, y] = [fl_x.or(of_angle(angle_x, width)), fl_y.or(of_angle(angle_y, height))];
        let (Some(fx), Some(fy)) = (x.or(y), y.or(x)) else {
            return Err(unusable(&"expected fl_x or camera_angle_x, found neither"));
        };
        let [cx, cy] = self.numbers(["cx", "cy"])?;
        let intrinsics = Intrinsics { fx, fy, cx: cx.unwrap_or(width / 2.0), cy: cy.unwrap_or(height / 2.0) };
        let intrinsics_norm = IntrinsicsNorm::from_pixels(intrinsics, width, height);
        intrinsics_norm.validate().map(|()| intrinsics_norm).map_err(|error| unusable(&error))
    }
}

/// Returns whether each of the frames of these names is held out of training: it is not in `train_filenames`, or is in
/// `val_filenames` or `test_filenames`. `None` if these lists name no frame. Adds a note on names without a frame.
fn held_out(top: &Keys<'_>, names: &[&str], notes: &mut Vec<String>) -> Result<Option<Vec<bool>>, serde_json::Error> {
    let normal =
        |path: &str| path.split(['/', '\\']).filter(|part| !["", "."].contains(part)).collect::<Vec<_>>().join("/");
    let names: Vec<String> = names.iter().map(|name| normal(name)).collect();
    let frames: HashSet<&str> = names.iter().map(String::as_str).collect();
    let mut unknown = Vec::new();
    let mut listed = |key: &str| -> serde_json::Result<HashSet<String>> {
        let items: Option<Vec<&RawValue>> =
            top.get(key).map(|list| serde_json::from_str(list.get())).transpose()?.flatten();
        let listed = items.iter().flatten().filter_map(|item| serde_json::from_str::<String>(item.get()).ok());
        let (known, others): (Vec<_>, Vec<_>) =
            listed.map(|name| normal(&name)).partition(|name| frames.contains(name.as_str()));
        unknown.extend(others.iter().map(|name| shown(name)));
        Ok(known.into_iter().collect())
    };
    let [train, val, test] = [listed("train_filenames")?, listed("val_filenames")?, listed("test_filenames")?];
    if !unknown.is_empty() {
        let count = plural(unknown.len(), "name");
        notes.push(format!("{count} in the lists of file names without a frame ({})", first_few(&unknown)));
    }
    let is_held_out = |name: &String| {
        if train.is_empty() { val.contains(name) || test.contains(name) } else { !train.contains(name) }
    };
    let has_lists = [&train, &val, &test].iter().any(|list| !list.is_empty());
    Ok(has_lists.then(|| names.iter().map(is_held_out).collect()))
}

/// Reads a `transforms.json` and locates its images. Frames are in the natural order of their names.
pub(crate) fn read_transforms(path: &Path, options: &PhotoOptions) -> Result<PhotoScene, DataError> {
    let bad = |what: String| DataError::BadScene { what, path: path.to_owned() };
    let text = read_bounded(path, MAX_BYTES, "reading the cameras")?;
    let expected = |error: serde_json::Error| bad(format!("expected the format of nerfstudio, got {error}"));
    let text = if parse_json::<IgnoredAny>(&text).is_ok() { text } else { mended(&text) };
    let top: Keys<'_> = parse_json(&text).map_err(expected)?;
    let items =
        top.get("frames").ok_or_else(|| bad("expected the format of nerfstudio, missing field `frames`".into()))?;
    let items: Vec<&RawValue> = serde_json::from_str(items.get()).map_err(expected)?;
    if items.len() > MAX_FRAMES {
        return Err(bad(format!("a list of more than {MAX_FRAMES} items")));
    }
    let (folder, mut scene) = (folder_of(path), PhotoScene::default());
    let mut frames = Vec::new();
    for (position, item) in items.into_iter().enumerate() {
        match Frame::parse(item, &top) {
            Ok(frame) => frames.push(frame),
            Err((name, what)) => {
                let name = name.unwrap_or_else(|| format!("frames[{position}]"));
                scene.skip(name, format!("whose entry is malformed: {what}"));
            }
        }
    }
    frames.sort_by(|a, b| natural_order(&a.name, &b.name));
    let mut images = ImageLocator::new(folder, options);
    let (mut used, mut scales, mut guessed) = (HashSet::new(), Vec::new(), Vec::new());
    let names: Vec<&str> = frames.iter().map(|frame| frame.name.as_str()).collect();
    let held_out = held_out(&top, &names, &mut scene.notes).map_err(expected)?;
    for (position, frame) in frames.iter().enumerate() {
        let photo = images.find(&frame.name).and_then(|image| {
            if !used.insert(image.clone()) {
                return Err("with the image of another frame".into());
            }
            let mask: Option<String> = frame.value("mask_path")?;
            let mask = mask.map(|mask| folder.join(mask.replace('\\', "/")));
            if mask.as_ref().is_some_and(|mask| !mask.is_file()) {
                return Err("without the mask of its mask_path".to_owned());
            }
            let (lens, mut given) = (frame.lens()?, frame.size()?);
            let size = if let Some(size) = given {
                size
            } else {
                let (stored, tag) = read_header(&image).map_err(|_| "whose image cannot be read".to_owned())?;
                let stored = stored.map(|side| side as f64);
                let is_turned = options.poses_from == PosesFrom::Turned && exchanges(tag);
                let assumed = if is_turned { [stored[1], stored[0]] } else { stored };
                let is_larger;
                (given, is_larger) = frame.guessed_size(stored, assumed, exchanges(tag))?;
                let size = given.unwrap_or(assumed);
                guessed.extend(is_larger.then_some(size));
                size
            };
            let intrinsics_norm = frame.intrinsics_norm(size)?;
            let (c2w, scale) = frame.pose()?;
            scales.extend(scale);
            let photo = Photo::new(image, c2w, intrinsics_norm, given, (lens, options.undistort));
            photo.map(|photo| Photo { mask, ..photo }).map_err(|error| unusable(&error))
        });
        match photo {
            Ok(photo) => {
                let is_held_out = held_out.as_ref().map(|held_out| held_out[position]);
                scene.photos.push(Photo { is_held_out, ..photo });
            }
            Err(reason) => scene.skip(&frame.name, reason),
        }
    }
    if held_out.is_some() {
        let count = scene.photos.iter().filter(|photo| photo.is_held_out == Some(true)).count();
        let of = plural(scene.photos.len(), "frame");
        scene.notes.push(format!("{count} of {of} held out by the lists of file names in {}", path.display()));
    }
    scene.notes.extend(note_on_scales(scales.into_iter(), path));
    if let Some([width, height]) = guessed.last() {
        scene.notes.push(format!(
            "{} without w and h in {}, smaller than their principal point says: the intrinsics are taken as those of \
             images of {width:.0}x{height:.0}; write w and h",
            plural(guessed.len(), "image"),
            path.display()
        ));
    }
    Ok(scene)
}
