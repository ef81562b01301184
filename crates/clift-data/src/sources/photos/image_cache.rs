//! A cache on disk of photos, decoded, undistorted and scaled to the size of training.

use std::collections::HashMap;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::UNIX_EPOCH;

use clift_core::{BadConfig, RgbImage, TEMPORARY, check_config};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::error::DataError;
use crate::files::caches::cache_folder;
use crate::files::listing::has_ending;
use crate::image::fit::covering_size;
use crate::image::lanczos::resize_lanczos;
use crate::sources::photos::photo::Photo;

/// Start of a file; the number changes with the pixels that a photo gives.
const MAGIC: &[u8; 8] = b"cliftim1";
/// Extension of the files.
const EXTENSION: &str = "clift-image";
/// Smallest size of a cached photo in pixels: smaller ones are decoded in a few milliseconds.
const MIN_PIXELS: usize = 640 * 480;
/// Smallest number of pixels of a cached photo over those of the scaled image.
const MIN_RATIO: usize = 4;

/// Cache on disk of large photos, decoded and scaled to the size of training. Deleting it costs only time.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ImageCacheConfig {
    /// Folder of the cache; by default `clift/images` in the user's folder for caches, such as `~/.cache`.
    pub folder: Option<PathBuf>,
    /// Largest size in gigabytes; 0 disables the cache.
    pub max_gb: f64,
}

impl Default for ImageCacheConfig {
    fn default() -> Self {
        Self { folder: None, max_gb: 4.0 }
    }
}

impl ImageCacheConfig {
    /// Checks every field.
    pub fn validate(&self) -> Result<(), BadConfig> {
        let is_valid = self.max_gb.is_finite() && self.max_gb >= 0.0;
        check_config(is_valid, "max_gb", self.max_gb, || "use 0 or more gigabytes".into())
    }

    /// Returns the configured folder, or the default one if the environment has a folder for caches.
    fn folder(&self) -> Option<PathBuf> {
        self.folder.clone().or_else(|| Some(cache_folder()?.join("images")))
    }
}

/// The cache of one image size. A file is named by a hash of everything that its pixels depend on: path, size and time of
/// the photo, lens, and image size. Files of several processes do not disturb one another.
pub(crate) struct ImageCache {
    folder: PathBuf,
    /// Columns and rows of training.
    size: [usize; 2],
    max_bytes: u64,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    num_bytes: u64,
    /// Files that this process has not used, with their sizes. They make room for others.
    unused: HashMap<String, u64>,
}

impl ImageCache {
    /// Opens the cache; `None` if it is disabled or has no folder.
    pub fn open(config: &ImageCacheConfig, size: [usize; 2]) -> Option<Self> {
        let max_bytes = (config.max_gb * 1e9) as u64;
        let folder = config.folder().filter(|_| max_bytes > 0)?;
        let files = std::fs::read_dir(&folder).into_iter().flatten().flatten().filter_map(|item| {
            let name = item.file_name().into_string().ok().filter(|name| has_ending(name, EXTENSION))?;
            Some((name, item.metadata().ok()?.len()))
        });
        let unused: HashMap<String, u64> = files.collect();
        let state = Mutex::new(State { num_bytes: unused.values().sum(), unused });
        Some(Self { folder, size, max_bytes, state })
    }

    /// Returns the photo, scaled to the smallest size that covers the size of training if it is much larger. `decode`
    /// decodes and undistorts the photo. An image fitted to the size of training has the same pixels as without the cache.
    ///
    /// A cache that cannot be read or written only costs time.
    pub fn scaled(
        &self,
        photo: &Photo,
        decode: impl FnOnce() -> Result<RgbImage, DataError>,
    ) -> Result<RgbImage, DataError> {
        let Some(name) = self.file_name(photo) else { return decode() };
        let path = self.folder.join(&name);
        if let Some(image) = read(&path) {
            self.lock().unused.remove(&name);
            return Ok(image);
        }
        let image = decode()?;
        let (width, height) = covering_size((image.width, image.height), (self.size[0], self.size[1]));
        let num_pixels = image.width * image.height;
        if num_pixels < MIN_PIXELS || num_pixels < MIN_RATIO * width * height || width * height == 0 {
            return Ok(image);
        }
        let scaled = resize_lanczos(&image, width, height);
        self.store(&path, &scaled);
        Ok(scaled)
    }

    fn file_name(&self, photo: &Photo) -> Option<String> {
        let metadata = std::fs::metadata(&photo.path).ok()?;
        let time = metadata.modified().ok()?.duration_since(UNIX_EPOCH).ok()?;
        let path = std::path::absolute(&photo.path).ok()?;
        let Photo { undistortion, shape, view_turn, poses_from, .. } = photo;
        let (path, bytes) = (path.display(), metadata.len());
        let key =
            format!("{path}\n{bytes} {time:?} {undistortion:?} {shape:?} {view_turn:?} {poses_from:?} {:?}", self.size);
        Some(format!("{}.{EXTENSION}", hex::encode(&Sha256::digest(key)[..16])))
    }

    /// Writes an image if there is room for it, or if unused files make room.
    fn store(&self, path: &Path, image: &RgbImage) {
        let bytes = to_bytes(image);
        let num_bytes = bytes.len() as u64;
        if !self.make_room(num_bytes) {
            return;
        }
        let written = std::fs::create_dir_all(&self.folder).and_then(|()| {
            // Not synced: the checksum detects a file that a power cut leaves incomplete.
            let mut file = tempfile::Builder::new().prefix(TEMPORARY).tempfile_in(&self.folder)?;
            file.write_all(&bytes)?;
            file.persist(path).map_err(std::io::Error::from)
        });
        if written.is_ok() {
            self.lock().num_bytes += num_bytes;
        }
    }

    /// Removes unused files until `num_bytes` fit. Returns whether they fit.
    fn make_room(&self, num_bytes: u64) -> bool {
        let mut state = self.lock();
        while state.num_bytes + num_bytes > self.max_bytes {
            let Some(name) = state.unused.keys().next().cloned() else { return false };
            let freed = state.unused.remove(&name).unwrap_or_default();
            state.num_bytes = state.num_bytes.saturating_sub(freed);
            // Another process may have removed it.
            let _ = std::fs::remove_file(self.folder.join(name));
        }
        true
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Returns the file of an image: [`MAGIC`], columns and rows as u32, pixels, CRC-32 of all before it.
fn to_bytes(image: &RgbImage) -> Vec<u8> {
    let sides = [image.width, image.height].map(|side| (side as u32).to_le_bytes());
    let mut bytes = [&MAGIC[..], &sides.concat(), &image.rgb].concat();
    bytes.extend(crc32fast::hash(&bytes).to_le_bytes());
    bytes
}

/// Reads the file of an image; `None` for a missing or damaged one.
fn read(path: &Path) -> Option<RgbImage> {
    let bytes = std::fs::read(path).ok()?;
    let (content, checksum) = bytes.split_last_chunk()?;
    if crc32fast::hash(content) != u32::from_le_bytes(*checksum) {
        return None;
    }
    let rest = content.strip_prefix(MAGIC)?;
    let (width, rest) = rest.split_first_chunk()?;
    let (height, rgb) = rest.split_first_chunk()?;
    let [width, height] = [width, height].map(|side| u32::from_le_bytes(*side) as usize);
    (rgb.len() == width * height * 3).then(|| RgbImage { width, height, rgb: rgb.to_vec() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::lens::Lens;
    use crate::image::codec::{encode_jpeg, encode_png};
    use crate::image::fit::fit_image;
    use crate::testing::{names, ramp};
    use clift_core::{IntrinsicsNorm, Pose};

    const K: IntrinsicsNorm = IntrinsicsNorm { fx: 0.9, fy: 1.2, cx: 0.5, cy: 0.52 };

    fn photo(folder: &Path, name: &str, image: &RgbImage, lens: Lens) -> Photo {
        let path = folder.join(name);
        std::fs::write(&path, encode_png(image).unwrap()).unwrap();
        Photo::new(path, Pose::IDENTITY, K, None, (lens, true)).unwrap()
    }

    fn cache(folder: &Path, max_bytes: u64) -> ImageCache {
        let config = ImageCacheConfig { folder: Some(folder.join("cache")), max_gb: max_bytes as f64 / 1e9 };
        ImageCache::open(&config, [32, 32]).unwrap()
    }

    /// Returns the photo through the cache, and whether it was decoded.
    fn read_through(cache: &ImageCache, photo: &Photo) -> (RgbImage, bool) {
        let mut is_decoded = false;
        let image = cache.scaled(photo, || {
            is_decoded = true;
            photo.decode([0; 3], "k", 0).map(|(image, _)| image)
        });
        (image.unwrap(), is_decoded)
    }

    #[test]
    fn cached_photos_fit_to_the_same_pixels() {
        let root = tempfile::tempdir().unwrap();
        let distorted = Lens::from_colmap("SIMPLE_RADIAL", &[0.05]).unwrap();
        let cache = cache(root.path(), 1_000_000);
        for (name, lens) in [("a.png", Lens::default()), ("b.png", distorted)] {
            let photo = photo(root.path(), name, &ramp(647, 801), lens);
            let fitted = |image: &RgbImage| fit_image(image, photo.camera.intrinsics, 32, 32, false).unwrap();
            let expected = fitted(&photo.decode([0; 3], "k", 0).unwrap().0);
            for is_decoded in [true, false] {
                let (image, was_decoded) = read_through(&cache, &photo);
                assert_eq!((fitted(&image), was_decoded), (expected.clone(), is_decoded));
                assert!(image.width < 40 && image.height < 45, "{}x{}", image.width, image.height);
            }
        }
        let small = photo(root.path(), "small.png", &ramp(200, 150), distorted);
        assert!(read_through(&cache, &small).1 && read_through(&cache, &small).1);
        assert_eq!(names(&root.path().join("cache")).len(), 2);
    }

    #[test]
    fn changed_photos_and_damaged_files_are_decoded_again() {
        let root = tempfile::tempdir().unwrap();
        let pinhole = Lens::default();
        let first = photo(root.path(), "a.png", &ramp(640, 480), pinhole);
        let cache = cache(root.path(), 1_000_000);
        assert_eq!([(); 2].map(|()| read_through(&cache, &first).1), [true, false]);
        let changed = photo(root.path(), "a.png", &ramp(640, 482), pinhole);
        assert_eq!([(); 2].map(|()| read_through(&cache, &changed).1), [true, false]);

        let folder = root.path().join("cache");
        for name in names(&folder) {
            let mut bytes = std::fs::read(folder.join(&name)).unwrap();
            bytes[20] ^= 1;
            std::fs::write(folder.join(&name), bytes).unwrap();
        }
        assert_eq!([(); 2].map(|()| read_through(&cache, &changed).1), [true, false]);
        std::fs::remove_dir_all(&folder).unwrap();
        assert_eq!([(); 2].map(|()| read_through(&cache, &changed).1), [true, false]);
    }

    #[test]
    fn size_is_bounded_and_unused_files_make_room() {
        let root = tempfile::tempdir().unwrap();
        let pinhole = Lens::default();
        let photos = ["a.png", "b.png", "c.png"].map(|name| photo(root.path(), name, &ramp(640, 640), pinhole));
        let file_bytes = to_bytes(&ramp(32, 32)).len() as u64;
        let decoded = |cache: &ImageCache| photos.each_ref().map(|photo| read_through(cache, photo).1);
        let cache_of_two = || cache(root.path(), 2 * file_bytes + 1);
        let first = cache_of_two();
        assert_eq!([decoded(&first), decoded(&first)], [[true, true, true], [false, false, true]], "own files stay");
        let second = cache_of_two();
        assert!(read_through(&second, &photos[2]).1);
        assert!(!read_through(&second, &photos[2]).1, "a file of the first made room");
        assert_eq!(names(&root.path().join("cache")).len(), 2);
        let disabled = ImageCacheConfig { max_gb: 0.0, ..ImageCacheConfig::default() };
        assert!(ImageCache::open(&disabled, [32, 32]).is_none());
        let error = ImageCacheConfig { max_gb: -1.0, ..disabled }.validate().unwrap_err();
        assert_eq!(error.to_string(), "`max_gb` = -1: use 0 or more gigabytes");
    }

    /// Figures of docs/results/performance.md.
    #[test]
    #[ignore = "measures; run with --ignored --nocapture for the times"]
    fn cached_photos_are_read_20_times_faster() {
        let root = tempfile::tempdir().unwrap();
        let distorted = Lens::from_colmap("SIMPLE_RADIAL", &[0.05]).unwrap();
        let mut photo = photo(root.path(), "a.png", &ramp(4, 4), distorted);
        photo.path = root.path().join("a.jpg");
        std::fs::write(&photo.path, encode_jpeg(&ramp(1080, 1920), 95).unwrap()).unwrap();
        let cache = cache(root.path(), 1_000_000);
        let [decoded_s, cached_s] = [1, 50].map(|repeats| {
            let started = std::time::Instant::now();
            (0..repeats).for_each(|_| drop(read_through(&cache, &photo)));
            started.elapsed().as_secs_f64() / f64::from(repeats)
        });
        println!("decoded {:.1} ms, cached {:.3} ms", 1e3 * decoded_s, 1e3 * cached_s);
        assert!(decoded_s > 20.0 * cached_s, "{decoded_s} s, {cached_s} s");
    }
}
