//! Scenes of one file per frame: RealEstate10K's text, DL3DV's folders, own captures.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};

use rayon::prelude::*;

use crate::error::DataError;
use crate::geometry::camera::Camera;
use crate::image::rgb_image::RgbImage;
use crate::scene_source::SceneSource;
use crate::skip_report::{SkipReport, first_few, plural};
use crate::sources::filters::SceneFilters;
use crate::sources::keys::find_by_name;
use crate::sources::photos::photo::{MissingPhoto, Photo, PhotoOptions, PhotoScene};
use crate::sources::photos::scene_folder::SceneFolder;

/// Photos of the scenes that are kept in memory, about 300 bytes each.
const MAX_PHOTOS_KEPT: usize = 200_000;
/// Scenes that are kept in memory.
const MAX_SCENES_KEPT: usize = 256;
/// Frames that are named in the ledger; those beyond are counted.
const MAX_FRAMES_NAMED: usize = 10_000;
/// The reason of a frame whose picture is not there.
const NO_PICTURE: &str = "without a picture";

/// What is asked of the scenes.
#[derive(Clone, Debug, Default)]
pub(crate) struct PhotoSourceOptions {
    pub photos: PhotoOptions,
    pub filters: SceneFilters,
    /// Whether a scene with a frame that has no usable picture is left out: published indices count positions of the
    /// complete scene.
    pub whole_scenes: bool,
    /// Fewest columns and rows of a usable picture.
    pub min_size: [usize; 2],
}

/// Scenes sorted by key. Cameras are read when a scene is used, and kept for the scenes used last.
pub(crate) struct PhotoSource {
    scenes: Vec<Entry>,
    positions: HashMap<String, usize>,
    options: PhotoOptions,
    ledger: SkipReport,
    kept: Mutex<Vec<(usize, Arc<PhotoScene>)>>,
}

struct Entry {
    folder: SceneFolder,
    num_frames: usize,
    /// Positions, among the pictures found, of those that cannot be used.
    unusable: Vec<usize>,
}

/// What is found of a scene at opening.
struct Findings {
    num_frames: usize,
    unusable: Vec<usize>,
    missing: Vec<MissingPhoto>,
    num_without_camera: usize,
    notes: Vec<String>,
    /// Why it is left out, with an error for when it is the only one.
    reason: Option<(String, Option<DataError>)>,
}

impl PhotoSource {
    /// Reads the cameras of every scene, on all cores, and finds their pictures; of the pictures, head and end of
    /// every one, or with `whole_scenes` of each scene's first.
    ///
    /// # Errors
    /// [`DataError::BadConfig`] for wrong filters, and the first scene's error when no scene can be read.
    pub fn open(folders: Vec<SceneFolder>, options: &PhotoSourceOptions) -> Result<Self, DataError> {
        options.filters.validate()?;
        let findings: Vec<_> = folders.par_iter().map(|folder| examine(folder, options)).collect();
        let mut ledger = SkipReport::new(folders.len());
        let (mut scenes, mut first_error, mut num_unnamed) = (Vec::new(), None, 0);
        let (mut num_spare, mut spare) = (0, Vec::new());
        for (folder, findings) in folders.into_iter().zip(findings) {
            let findings = findings.unwrap_or_else(|error| Findings {
                num_frames: 0,
                unusable: Vec::new(),
                missing: Vec::new(),
                num_without_camera: 0,
                notes: Vec::new(),
                reason: Some((error.to_string(), Some(error))),
            });
            let Findings { num_frames, unusable, missing, num_without_camera, notes, reason } = findings;
            let has_photos = num_frames > 0;
            if let Some((reason, error)) = reason {
                ledger.skip(&folder.key, reason);
                first_error = first_error.or(error);
            } else {
                ledger.notes.extend(notes);
                if num_without_camera > 0 {
                    num_spare += num_without_camera;
                    spare.push(format!("{num_without_camera} of {}", folder.key));
                }
                scenes.push(Entry { folder: folder.clone(), num_frames, unusable });
            }
            // Of a scene without any picture the frames say nothing more.
            for MissingPhoto { name, reason } in missing.into_iter().filter(|_| has_photos) {
                if ledger.frames.len() < MAX_FRAMES_NAMED {
                    ledger.skip_frame(&folder.key, name, reason);
                } else {
                    num_unnamed += 1;
                }
            }
        }
        if num_unnamed > 0 {
            ledger.notes.push(format!("{num_unnamed} more frames left out"));
        }
        if num_spare > 0 {
            let note = format!("{} without a camera, not used: {}", plural(num_spare, "picture"), first_few(&spare));
            ledger.notes.push(note);
        }
        if let (true, Some(error)) = (scenes.is_empty(), first_error) {
            return Err(error);
        }
        let positions = scenes.iter().enumerate().map(|(place, scene)| (scene.folder.key.clone(), place)).collect();
        Ok(Self { scenes, positions, options: options.photos.clone(), ledger, kept: Mutex::default() })
    }

    /// What was left out.
    pub fn ledger(&self) -> &SkipReport {
        &self.ledger
    }

    fn entry(&self, scene: usize) -> Result<&Entry, DataError> {
        let num_scenes = self.scenes.len();
        self.scenes.get(scene).ok_or(DataError::NoSuchScene { scene, num_scenes })
    }

    fn scene(&self, scene: usize) -> Result<Arc<PhotoScene>, DataError> {
        let entry = self.entry(scene)?;
        let lock = || self.kept.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        {
            let mut kept = lock();
            if let Some(place) = kept.iter().position(|(other, _)| *other == scene) {
                let found = kept.remove(place);
                let photos = found.1.clone();
                kept.push(found);
                return Ok(photos);
            }
        }
        let mut read = entry.folder.read(&self.options)?;
        let mut place = 0;
        read.photos.retain(|_| {
            place += 1;
            entry.unusable.binary_search(&(place - 1)).is_err()
        });
        if read.photos.len() != entry.num_frames {
            let what = format!("it had {} frames when it was opened, and has {}", entry.num_frames, read.photos.len());
            return Err(DataError::BadScene { what, path: entry.folder.path().to_owned() });
        }
        let read = Arc::new(read);
        let mut kept = lock();
        kept.push((scene, read.clone()));
        let mut num_photos: usize = kept.iter().map(|(_, scene)| scene.photos.len()).sum();
        while kept.len() > 1 && (kept.len() > MAX_SCENES_KEPT || num_photos > MAX_PHOTOS_KEPT) {
            num_photos -= kept.remove(0).1.photos.len();
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

/// Reads a scene and says whether it can be used.
fn examine(folder: &SceneFolder, options: &PhotoSourceOptions) -> Result<Findings, DataError> {
    let PhotoScene { photos, mut missing, num_without_camera, notes, .. } = folder.read(&options.photos)?;
    let num_listed = photos.len() + missing.len();
    let (mut unusable, mut first_error, mut is_small) = (Vec::new(), None, false);
    let num_checked = if options.whole_scenes { 1 } else { photos.len() };
    for (place, photo) in photos.iter().enumerate().take(num_checked) {
        match photo.size() {
            Ok([width, height]) => is_small |= width < options.min_size[0] || height < options.min_size[1],
            Err(error) => {
                let name = photo.path.file_name().unwrap_or_default().to_string_lossy().into_owned();
                let reason = match &error {
                    DataError::BadScene { what, .. } if what.contains("EXIF orientation") => {
                        "whose picture has another shape than its camera, and an EXIF orientation, which is not applied"
                    }
                    DataError::BadScene { what, .. } if what.contains("turned or cropped") => {
                        "whose picture has another shape than its camera"
                    }
                    DataError::BadScene { what, .. } if what.contains("truncated") => "whose picture is truncated",
                    _ => "whose picture cannot be read",
                };
                missing.push(MissingPhoto { name, reason: reason.into() });
                unusable.push(place);
                first_error.get_or_insert(error);
            }
        }
    }
    let num_frames = photos.len() - unusable.len();
    let reason = if num_frames == 0 {
        let without_picture = missing.iter().all(|photo| photo.reason == NO_PICTURE);
        let telling = missing.iter().find(|photo| photo.reason != NO_PICTURE).or(missing.first());
        let error = first_error.unwrap_or_else(|| {
            let what = match telling {
                None => "it lists no frames".into(),
                Some(MissingPhoto { name, .. }) if without_picture => {
                    format!("none of its {num_listed} frames has a picture, the first being {name}")
                }
                Some(MissingPhoto { name, reason }) => {
                    format!("none of its {num_listed} frames can be used; {name} is one {reason}")
                }
            };
            DataError::BadScene { what, path: folder.path().to_owned() }
        });
        let is_plain = num_listed > 0 && without_picture;
        Some((if is_plain { "without any picture".into() } else { error.to_string() }, Some(error)))
    } else if options.whole_scenes && !missing.is_empty() {
        let reason = match (&first_error, missing.iter().find(|photo| photo.reason != NO_PICTURE)) {
            (Some(error), _) => error.to_string(),
            (None, Some(photo)) => format!("with frames {}", photo.reason),
            (None, None) => "with frames that have no picture".into(),
        };
        Some((reason, first_error))
    } else if is_small {
        let [width, height] = options.min_size;
        Some((format!("with pictures smaller than {width}x{height}"), None))
    } else {
        let cameras = || Ok(photos.iter().map(|photo| photo.camera).collect());
        options.filters.reason_to_skip(num_frames, cameras)?.map(|reason| (reason, None))
    };
    // A data set whose frames have not been extracted has millions of them to name.
    missing.truncate(if photos.is_empty() { 1 } else { MAX_FRAMES_NAMED });
    Ok(Findings { num_frames, unusable, missing, num_without_camera, notes, reason })
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

    fn cameras(&self, scene: usize) -> Result<Vec<Camera>, DataError> {
        Ok(self.scene(scene)?.photos.iter().map(|photo| photo.camera).collect())
    }

    fn timestamps(&self, scene: usize) -> Result<Vec<i64>, DataError> {
        Ok(self.scene(scene)?.timestamps())
    }

    fn url(&self, scene: usize) -> Result<String, DataError> {
        Ok(self.scene(scene)?.url.clone())
    }

    fn frame(&self, scene: usize, frame: usize) -> Result<RgbImage, DataError> {
        self.photo(scene, frame)?.decode(self.key(scene), frame)
    }

    fn encoded_frame(&self, scene: usize, frame: usize) -> Result<Option<Vec<u8>>, DataError> {
        let photo = self.photo(scene, frame)?;
        if photo.undistortion.is_some() {
            return Ok(None);
        }
        photo.read().map(Some)
    }
}
