//! Scenes with one image file per frame: RealEstate10K, DL3DV, own captures.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};

use clift_core::{Camera, IntrinsicsNorm, RgbImage, widest_fov_deg};
use rayon::prelude::*;

use crate::error::DataError;
use crate::image::codec::has_alpha;
use crate::scene_source::SceneSource;
use crate::skip_report::{SkipReport, first_few, plural};
use crate::sources::filters::SceneFilters;
use crate::sources::keys::find_by_name;
use crate::sources::photos::image_cache::{ImageCache, ImageCacheConfig};
use crate::sources::photos::photo::{MissingPhoto, NO_IMAGE, Photo, PhotoHeader, PhotoOptions, PhotoScene};
use crate::sources::photos::scene_folder::SceneFolder;

/// Largest number of photos in the cache, about 300 bytes each.
const MAX_CACHED_PHOTOS: usize = 200_000;
const MAX_CACHED_SCENES: usize = 256;
/// Largest number of frames named in the report; further frames are counted.
const MAX_NAMED_FRAMES: usize = 10_000;

/// Images that a note counts.
const COUNTED: [&str; 6] = [
    "without a camera, not used",
    "turned by the EXIF orientation, as the size of the cameras requires",
    "with an EXIF orientation that is not applied, as the cameras have the stored size",
    "cut to the part of the lens that a pinhole camera can show, at most 120 degrees",
    "with a mask, whose black pixels get the colour data.background and do not count in loss and metrics",
    "with an alpha channel, whose transparent pixels get the colour data.background and do not count",
];

#[derive(Clone, Debug, Default)]
pub(crate) struct PhotoSourceOptions {
    pub photos: PhotoOptions,
    pub filters: SceneFilters,
    /// Whether scenes with an unusable frame are skipped: published evaluation indices refer to complete scenes.
    pub whole_scenes: bool,
    /// Smallest columns and rows of an image.
    pub min_size: [usize; 2],
    /// Cache of large photos, scaled to cover `min_size`.
    pub image_cache: Option<ImageCacheConfig>,
}

/// Scenes of photos, sorted by key. Cameras are read on use, and cached for the scenes used last.
pub(crate) struct PhotoSource {
    scenes: Vec<Entry>,
    positions: HashMap<String, usize>,
    options: PhotoOptions,
    pub report: SkipReport,
    image_cache: Option<ImageCache>,
    /// Scenes used last, with their indices; the latest at the end.
    cache: Mutex<Vec<(usize, Arc<PhotoScene>)>>,
}

struct Entry {
    folder: SceneFolder,
    num_frames: usize,
    /// Indices of unusable images among the images found.
    unusable: Vec<usize>,
}

/// Result of examining a scene at opening.
#[derive(Default)]
struct Findings {
    num_frames: usize,
    unusable: Vec<usize>,
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
    pub fn open(folders: Vec<SceneFolder>, options: &PhotoSourceOptions) -> Result<Self, DataError> {
        options.filters.validate()?;
        let findings: Vec<_> = folders.par_iter().map(|folder| examine(folder, options)).collect();
        let mut report = SkipReport::new(folders.len());
        let (mut scenes, mut first_error, mut num_unnamed) = (Vec::new(), None, 0);
        let mut counted: [(usize, Vec<String>); COUNTED.len()] = Default::default();
        for (folder, findings) in folders.into_iter().zip(findings) {
            let failed =
                |error: DataError| Findings { reason: Some((error.to_string(), Some(error))), ..Findings::default() };
            let findings = findings.unwrap_or_else(failed);
            let Findings { num_frames, unusable, missing, counts, notes, reason } = findings;
            let has_photos = num_frames > 0;
            if let Some((reason, error)) = reason {
                report.skip(&folder.key, reason);
                first_error = first_error.or(error);
            } else {
                report.notes.extend(notes);
                for ((total, scenes), count) in counted.iter_mut().zip(counts) {
                    *total += count;
                    scenes.extend((count > 0).then(|| format!("{count} of {}", folder.key)));
                }
                scenes.push(Entry { folder: folder.clone(), num_frames, unusable });
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
        let image_cache = options.image_cache.as_ref().and_then(|config| ImageCache::open(config, options.min_size));
        Ok(Self { scenes, positions, options: options.photos.clone(), report, image_cache, cache: Mutex::default() })
    }

    fn entry(&self, scene: usize) -> Result<&Entry, DataError> {
        self.scenes.get(scene).ok_or(DataError::NoSuchScene { scene, num_scenes: self.scenes.len() })
    }

    fn scene(&self, scene: usize) -> Result<Arc<PhotoScene>, DataError> {
        let entry = self.entry(scene)?;
        let lock = || self.cache.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        {
            let mut cache = lock();
            if let Some(position) = cache.iter().position(|(other, _)| *other == scene) {
                let found = cache.remove(position);
                let photos = found.1.clone();
                cache.push(found);
                return Ok(photos);
            }
        }
        let mut read = entry.folder.read(&self.options)?;
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
        cache.push((scene, read.clone()));
        let mut num_photos: usize = cache.iter().map(|(_, scene)| scene.photos.len()).sum();
        while cache.len() > 1 && (cache.len() > MAX_CACHED_SCENES || num_photos > MAX_CACHED_PHOTOS) {
            num_photos -= cache.remove(0).1.photos.len();
        }
        Ok(read)
    }

    fn photo(&self, scene: usize, frame: usize) -> Result<Photo, DataError> {
        let photos = &self.scene(scene)?.photos;
        photos.get(frame).cloned().ok_or_else(|| DataError::NoSuchFrame {
            key: self.key(scene).to_owned(),
            frame,
            num_frames: photos.len(),
        })
    }
}

fn examine(folder: &SceneFolder, options: &PhotoSourceOptions) -> Result<Findings, DataError> {
    let PhotoScene { photos, mut missing, num_without_camera, notes, .. } = folder.read(&options.photos)?;
    let num_listed = photos.len() + missing.len();
    let (mut unusable, mut first_error, mut is_small) = (Vec::new(), None, false);
    let (mut num_turned, mut num_unturned, mut num_with_alpha) = (0, 0, 0);
    let num_checked = if options.whole_scenes { 1 } else { photos.len() };
    for (position, photo) in photos.iter().enumerate().take(num_checked) {
        match photo.header() {
            Ok(PhotoHeader { size: [width, height], is_turned, has_unused_orientation }) => {
                is_small |= width < options.min_size[0] || height < options.min_size[1];
                num_turned += usize::from(is_turned);
                num_unturned += usize::from(has_unused_orientation);
                num_with_alpha += usize::from(has_alpha(&photo.path));
            }
            Err(error) => {
                let name = photo.path.file_name().unwrap_or_default().to_string_lossy().into_owned();
                let reason = match &error {
                    DataError::WrongAspect { .. } => "whose image has another aspect ratio than its camera",
                    DataError::TruncatedImage { .. } => "whose image is truncated",
                    _ => "whose image cannot be read",
                };
                missing.push(MissingPhoto { name, reason: reason.into() });
                unusable.push(position);
                first_error.get_or_insert(error);
            }
        }
    }
    let num_frames = photos.len() - unusable.len();
    let reason = if num_frames == 0 {
        let without_image = missing.iter().all(|photo| photo.reason == NO_IMAGE);
        let example = missing.iter().find(|photo| photo.reason != NO_IMAGE).or(missing.first());
        let error = first_error.unwrap_or_else(|| {
            let what = match example {
                None => "no frames listed".into(),
                Some(MissingPhoto { name, .. }) if without_image => {
                    format!("none of {num_listed} frames has an image; the first is {name}; data.files.image_folder names another folder of images")
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
    let num_cut = photos.iter().filter(|photo| photo.undistortion.as_ref().is_some_and(|lens| lens.is_cut())).count();
    let num_masked = photos.iter().filter(|photo| photo.mask.is_some()).count();
    let counts = [num_without_camera, num_turned, num_unturned, num_cut, num_masked, num_with_alpha];
    Ok(Findings { num_frames, unusable, missing, counts, notes, reason })
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

    fn timestamps(&self, scene: usize) -> Result<Vec<i64>, DataError> {
        Ok(self.scene(scene)?.timestamps())
    }

    fn url(&self, scene: usize) -> Result<String, DataError> {
        Ok(self.scene(scene)?.url.clone())
    }

    fn frame(&self, scene: usize, frame: usize) -> Result<RgbImage, DataError> {
        Ok(self.frame_with_coverage(scene, frame)?.0)
    }

    fn frame_with_coverage(&self, scene: usize, frame: usize) -> Result<(RgbImage, Option<RgbImage>), DataError> {
        let photo = self.photo(scene, frame)?;
        let decode = || photo.decode(self.options.background, self.key(scene), frame);
        match &self.image_cache {
            Some(cache) if !photo.has_coverage() => Ok((cache.scaled(&photo, || Ok(decode()?.0))?, None)),
            _ => decode(),
        }
    }

    fn encoded_frame(&self, scene: usize, frame: usize) -> Result<Option<Vec<u8>>, DataError> {
        let photo = self.photo(scene, frame)?;
        if photo.undistortion.is_some() || photo.has_coverage() || photo.header()?.is_turned {
            return Ok(None);
        }
        photo.read().map(Some)
    }

    fn image_size(&self, scene: usize, frame: usize) -> Result<[usize; 2], DataError> {
        Ok(self.photo(scene, frame)?.header()?.size)
    }

    fn frame_names(&self, scene: usize) -> Result<Vec<String>, DataError> {
        let name = |photo: &Photo| photo.path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        Ok(self.scene(scene)?.photos.iter().map(name).collect())
    }
}
