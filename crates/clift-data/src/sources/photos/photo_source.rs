//! Scenes with one image file per frame: RealEstate10K, DL3DV, own captures.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use clift_core::{Camera, DVec3, IntrinsicsNorm, RgbImage, first_few, plural, widest_fov_deg};
use image::metadata::Orientation;
use rayon::prelude::*;

use crate::error::DataError;
use crate::geometry::path_spread::far_cameras;
use crate::image::codec::has_alpha;
use crate::image::fit::covering_size;
use crate::image::lanczos::resize_lanczos;
use crate::scene_source::{SceneSource, is_held_out};
use crate::skip_report::SkipReport;
use crate::sources::keys::find_by_name;
use crate::sources::photos::photo::{MissingPhoto, NO_IMAGE, Photo, PhotoOptions, PhotoScene, Turn};
use crate::sources::photos::scene_folder::SceneFolder;

/// Largest number of photos in the cache, about 300 bytes each.
const MAX_CACHED_PHOTOS: usize = 200_000;
const MAX_CACHED_SCENES: usize = 256;
/// Largest number of frames that are named in the report.
const MAX_NAMED_FRAMES: usize = 10_000;

const FAR: &str = "whose camera is farther away than 20 times the median step or distance";

/// Images that a note counts.
const COUNTED: [&str; 6] = [
    "turned by the EXIF orientation, as the size of the cameras requires",
    "turned with their cameras by the EXIF orientation",
    "with an EXIF orientation that fits the cameras both ways; data.files.poses_from names the pixels of the poses",
    "cut to the part of the lens that a pinhole camera can show, at most 120 degrees",
    "with a mask, whose black pixels get the colour data.background and do not count in loss and metrics",
    "with an alpha channel, whose transparent pixels get the colour data.background and do not count",
];

/// Largest size of the decoded photos in memory, in bytes.
const MAX_DECODED_BYTES: usize = 1 << 30;
/// Photos are kept in memory if they have at least this many times the pixels of the scaled image.
const MIN_DECODED_RATIO: usize = 4;

/// Largest number of scenes, and of bytes of the images of a scene, whose JPEG files are read to find damage.
const MAX_CHECKED_SCENES: usize = 16;
const MAX_CHECKED_BYTES: u64 = 512 << 20;

/// Scenes of photos, sorted by key. Cameras are read on use, and kept for the scenes used lately.
pub(crate) struct PhotoSource {
    scenes: Vec<Entry>,
    positions: HashMap<String, usize>,
    options: PhotoOptions,
    pub report: SkipReport,
    /// Decoded photos by scene and frame, scaled to cover the smallest size, if the options ask for them.
    decoded: Mutex<HashMap<(usize, usize), RgbImage>>,
    /// Scenes used lately.
    cache: Mutex<HashMap<usize, Arc<PhotoScene>>>,
}

struct Entry {
    folder: SceneFolder,
    num_frames: usize,
    /// Indices of unusable images among the images found.
    unusable: Vec<usize>,
    /// Orientations by which images are turned with their cameras, by index.
    turns: Vec<(usize, Orientation)>,
    /// Whether the data of all images was checked at opening.
    is_checked: bool,
}

/// Result of examining a scene at opening.
struct Findings {
    entry: Entry,
    missing: Vec<MissingPhoto>,
    /// Numbers of images, as in [`COUNTED`].
    counts: [usize; COUNTED.len()],
    notes: Vec<String>,
    /// Reason of skipping the scene, with the error to return if all scenes fail.
    reason: Option<(String, Option<DataError>)>,
}

impl PhotoSource {
    /// Reads the cameras of every scene in parallel and locates their images. Header and end of every image are checked;
    /// with `whole_scenes`, only of the first image of a scene.
    pub fn open(folders: Vec<SceneFolder>, options: &PhotoOptions) -> Result<Self, DataError> {
        options.filters.validate()?;
        let checks_data = !options.whole_scenes && folders.len() <= MAX_CHECKED_SCENES;
        let findings: Vec<_> = folders.par_iter().map(|folder| examine(folder, options, checks_data)).collect();
        let mut report = SkipReport::new(folders.len());
        let (mut scenes, mut first_error, mut num_unnamed) = (Vec::new(), None, 0);
        let mut counted: [(usize, Vec<String>); COUNTED.len()] = Default::default();
        for (folder, findings) in folders.into_iter().zip(findings) {
            let Findings { entry, missing, counts, notes, reason } = match findings {
                Ok(findings) => findings,
                Err(error) => {
                    report.skip(folder.key, error.to_string());
                    first_error.get_or_insert(error);
                    continue;
                }
            };
            let has_photos = entry.num_frames > 0;
            if let Some((reason, error)) = reason {
                report.skip(&folder.key, reason);
                first_error = first_error.or(error);
            } else {
                report.notes.extend(notes);
                for ((total, scenes), count) in counted.iter_mut().zip(counts) {
                    *total += count;
                    scenes.extend((count > 0).then(|| format!("{count} of {}", folder.key)));
                }
                scenes.push(entry);
            }
            // Without any image, the reason of the scene covers all frames.
            for MissingPhoto { name, reason } in missing.into_iter().filter(|_| has_photos) {
                if report.frames.len() < MAX_NAMED_FRAMES {
                    report.skip_frame(&folder.key, name, reason);
                } else {
                    num_unnamed += 1;
                }
            }
        }
        if num_unnamed > 0 {
            report.notes.push(format!("{num_unnamed} more frames skipped"));
        }
        for (what, (total, scenes)) in COUNTED.iter().zip(counted).filter(|(_, (total, _))| *total > 0) {
            report.notes.push(format!("{} {what}: {}", plural(total, "image"), first_few(&scenes)));
        }
        if let (true, Some(error)) = (scenes.is_empty(), first_error) {
            return Err(error);
        }
        let positions = scenes.iter().enumerate().map(|(i, scene)| (scene.folder.key.clone(), i)).collect();
        let (options, decoded, cache) = (options.clone(), Mutex::default(), Mutex::default());
        Ok(Self { scenes, positions, options, report, decoded, cache })
    }

    fn entry(&self, scene: usize) -> Result<&Entry, DataError> {
        self.scenes.get(scene).ok_or(DataError::NoSuchScene { scene, num_scenes: self.scenes.len() })
    }

    fn scene(&self, scene: usize) -> Result<Arc<PhotoScene>, DataError> {
        let entry = self.entry(scene)?;
        let lock = || self.cache.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(found) = lock().get(&scene) {
            return Ok(found.clone());
        }
        let mut read = entry.folder.read(&self.options)?;
        for (position, orientation) in &entry.turns {
            read.photos.get_mut(*position).into_iter().for_each(|photo| photo.turn_view(*orientation));
        }
        let mut positions = 0..;
        read.photos
            .retain(|_| positions.next().is_some_and(|position| entry.unusable.binary_search(&position).is_err()));
        if read.photos.len() != entry.num_frames {
            let what =
                format!("{} frames at opening, {} now: the files have changed", entry.num_frames, read.photos.len());
            return Err(DataError::BadScene { what, path: entry.folder.path().to_owned() });
        }
        let read = Arc::new(read);
        let mut cache = lock();
        if cache.len() == MAX_CACHED_SCENES
            || cache.values().map(|scene| scene.photos.len()).sum::<usize>() > MAX_CACHED_PHOTOS
        {
            cache.clear();
        }
        cache.insert(scene, read.clone());
        Ok(read)
    }

    fn photo(&self, scene: usize, frame: usize) -> Result<Photo, DataError> {
        let photos = &self.scene(scene)?.photos;
        let (key, num_frames) = (self.key(scene), photos.len());
        photos.get(frame).cloned().ok_or_else(|| DataError::NoSuchFrame { key: key.to_owned(), frame, num_frames })
    }
}

fn examine(folder: &SceneFolder, options: &PhotoOptions, checks_data: bool) -> Result<Findings, DataError> {
    let scene = folder.read(options)?;
    let names = scene.names();
    let PhotoScene { photos, mut missing, notes, .. } = scene;
    let num_listed = photos.len() + missing.len();
    let (mut unusable, mut first_error, mut is_small) = (Vec::new(), None, false);
    let (mut turns, mut counts) = (Vec::new(), [0; COUNTED.len()]);
    let num_checked = if options.whole_scenes { 1 } else { photos.len() };
    let num_bytes = |photo: &Photo| std::fs::metadata(&photo.path).map_or(0, |metadata| metadata.len());
    let checks_data = checks_data && photos.iter().map(num_bytes).sum::<u64>() <= MAX_CHECKED_BYTES;
    let check = |photo: &Photo| {
        let header = photo.header()?;
        if checks_data { photo.check_data().map(|()| header) } else { Ok(header) }
    };
    let headers: Vec<_> = photos.par_iter().take(num_checked).map(check).collect();
    for (position, header) in headers.into_iter().enumerate() {
        match header {
            Ok(([width, height], turn)) => {
                is_small |= width < options.min_size[0] || height < options.min_size[1];
                let is_turned = [turn.pixels, turn.view].map(|turn| turn != Orientation::NoTransforms);
                turns.extend(is_turned[1].then_some((position, turn.view)));
                for (count, is_turned) in counts.iter_mut().zip(is_turned) {
                    *count += usize::from(is_turned && !turn.is_undecided);
                }
                counts[2] += usize::from(turn.is_undecided);
                counts[5] += usize::from(has_alpha(&photos[position].path));
            }
            Err(error) => {
                let reason = match &error {
                    DataError::BadPhoto { reason, .. } => reason,
                    _ => "whose image cannot be read",
                };
                missing.push(MissingPhoto { name: names[position].clone(), reason: reason.into() });
                unusable.push(position);
                first_error.get_or_insert(error);
            }
        }
    }
    if !options.whole_scenes {
        let centres: Vec<DVec3> = photos.iter().map(|photo| photo.camera.c2w.translation).collect();
        for position in
            far_cameras(&centres).into_iter().filter(|position| !unusable.contains(position)).collect::<Vec<_>>()
        {
            missing.push(MissingPhoto { name: names[position].clone(), reason: FAR.into() });
            unusable.push(position);
        }
        unusable.sort_unstable();
    }
    let num_frames = photos.len() - unusable.len();
    let reason = if num_frames == 0 {
        let without_image = missing.iter().all(|photo| photo.reason == NO_IMAGE);
        let example = missing.iter().find(|photo| photo.reason != NO_IMAGE).or(missing.first());
        let error = first_error.unwrap_or_else(|| {
            let what = match example {
                None => "no frames listed".into(),
                Some(MissingPhoto { name, .. }) if without_image => {
                    format!("none of {num_listed} frames has an image; the first is {name}; {}", folder.image_hint())
                }
                Some(MissingPhoto { name, reason }) => {
                    format!("none of {num_listed} frames is usable; {name} is a frame {reason}")
                }
            };
            DataError::BadScene { what, path: folder.path().to_owned() }
        });
        let is_plain = num_listed > 0 && without_image;
        Some((if is_plain { "without any image".into() } else { error.to_string() }, Some(error)))
    } else if options.whole_scenes && !missing.is_empty() {
        let reason = match (&first_error, missing.iter().find(|photo| photo.reason != NO_IMAGE)) {
            (Some(error), _) => error.to_string(),
            (None, Some(photo)) => format!("with frames {}", photo.reason),
            (None, None) => "with frames that have no image".into(),
        };
        Some((reason, first_error))
    } else if is_small {
        let [width, height] = options.min_size;
        Some((format!("with images smaller than {width}x{height}"), None))
    } else {
        let fov_deg = || Ok(widest_fov_deg(&photos.iter().map(|photo| photo.camera).collect::<Vec<_>>()));
        options.filters.reason_to_skip(num_frames, fov_deg)?.map(|reason| (reason, None))
    };
    // Without extracted frames, a data set has millions of missing ones.
    missing.truncate(if photos.is_empty() { 1 } else { MAX_NAMED_FRAMES });
    counts[3] = photos.iter().filter(|photo| photo.undistortion.as_ref().is_some_and(|lens| lens.is_cut())).count();
    let is_masked = |(position, photo): &(usize, &Photo)| photo.mask.is_some() && !unusable.contains(position);
    counts[4] = photos.iter().enumerate().filter(is_masked).count();
    let entry = Entry { folder: folder.clone(), num_frames, unusable, turns, is_checked: checks_data };
    Ok(Findings { entry, missing, counts, notes, reason })
}

impl SceneSource for PhotoSource {
    fn num_scenes(&self) -> usize {
        self.scenes.len()
    }

    fn key(&self, scene: usize) -> &str {
        &self.scenes[scene].folder.key
    }

    fn find(&self, key: &str) -> Option<usize> {
        let by_name = || find_by_name(self.scenes.iter().map(|scene| scene.folder.key.as_str()), key);
        self.positions.get(key).copied().or_else(by_name)
    }

    fn num_frames(&self, scene: usize) -> Result<usize, DataError> {
        Ok(self.entry(scene)?.num_frames)
    }

    fn cameras(&self, scene: usize) -> Result<Vec<Camera<IntrinsicsNorm>>, DataError> {
        Ok(self.scene(scene)?.photos.iter().map(|photo| photo.camera).collect())
    }

    fn frame(&self, scene: usize, frame: usize) -> Result<RgbImage, DataError> {
        Ok(self.frame_with_coverage(scene, frame)?.0)
    }

    fn frame_with_coverage(&self, scene: usize, frame: usize) -> Result<(RgbImage, Option<RgbImage>), DataError> {
        let photo = self.photo(scene, frame)?;
        let decode = || photo.decode(self.options.background, self.options.min_size, self.key(scene), frame);
        let lock = || self.decoded.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(image) = lock().get(&(scene, frame)) {
            return Ok((image.clone(), None));
        }
        if !self.options.caches_photos || photo.has_coverage() {
            return decode();
        }
        let (image, _) = decode()?;
        let (width, height) = covering_size((image.width, image.height), self.options.min_size.into());
        if image.width * image.height < MIN_DECODED_RATIO * width * height || width * height == 0 {
            return Ok((image, None));
        }
        let image = resize_lanczos(&image, width, height);
        let mut decoded = lock();
        let num_bytes: usize = decoded.values().map(|image| image.rgb.len()).sum();
        if num_bytes + image.rgb.len() <= MAX_DECODED_BYTES {
            decoded.insert((scene, frame), image.clone());
        }
        Ok((image, None))
    }

    fn check_frame(&self, scene: usize, frame: usize) -> Result<(), DataError> {
        if self.scenes[scene].is_checked { Ok(()) } else { self.photo(scene, frame)?.check_data() }
    }

    fn encoded_frame(&self, scene: usize, frame: usize) -> Result<Option<Vec<u8>>, DataError> {
        let photo = self.photo(scene, frame)?;
        if photo.undistortion.is_some() || photo.has_coverage() || photo.header()?.1 != Turn::NONE {
            return Ok(None);
        }
        photo.read().map(Some)
    }

    fn image_size(&self, scene: usize, frame: usize) -> Result<[usize; 2], DataError> {
        Ok(self.photo(scene, frame)?.header()?.0)
    }

    fn frame_names(&self, scene: usize) -> Result<Vec<String>, DataError> {
        Ok(self.scene(scene)?.names())
    }

    fn held_out(&self, scene: usize, every: usize) -> Result<Vec<usize>, DataError> {
        let photos = self.scene(scene)?;
        let is_listed = every > 0 && photos.photos.iter().any(|photo| photo.is_held_out.is_some());
        let is_held_out = |(frame, photo): (usize, &Photo)| {
            if is_listed { photo.is_held_out.unwrap_or_default() } else { is_held_out(frame, every) }
        };
        let frames = photos.photos.iter().enumerate().filter(|frame| is_held_out(*frame));
        Ok(frames.map(|(frame, _)| frame).collect())
    }
}
