//! Opening data sets on disk in any layout.

use std::collections::HashSet;
use std::path::PathBuf;
use std::sync::Arc;

use crate::error::DataError;
use crate::files::caches::cache_folder;
use crate::files::listing::file_names;
use crate::scene_source::{SceneSource, Split};
use crate::skip_report::SkipReport;
use crate::sources::chunks::chunk_source::{ChunkSource, ScanProgress};
use crate::sources::chunks::index::{index_of_files, note_unlisted, read_index};
use crate::sources::chunks::index_cache::ChunkIndexCache;
use crate::sources::dataset_root::{DatasetRoot, DetectedSource, SplitFolder};
use crate::sources::kind::SourceKind;
use crate::sources::options::SourceOptions;
use crate::sources::photos::photo::PhotoOptions;
use crate::sources::photos::photo_source::{PhotoSource, PhotoSourceOptions};
use crate::sources::photos::scene_folder::{SceneFiles, SceneFolder};
use crate::sources::subset::SceneSubset;
use crate::sources::test_scenes::TestScenes;
use clift_core::BadConfig;

/// Image folders of DL3DV scenes, by preference: 480 x 270, then larger.
const DL3DV_FOLDERS: &[&str] = &["images_8", "images_4", "images_2"];

/// Smallest number of chunks with a chunk index cache; fewer are read in a second.
const MIN_CACHED_CHUNKS: usize = 100;

/// An open data set.
pub struct OpenedSource {
    /// Scenes of the data set.
    pub source: Arc<dyn SceneSource>,
    /// Detected layout, or [`SourceKind::Synthetic`].
    pub kind: SourceKind,
    /// Whether both splits are the same scenes: without folders `train/` and `test/` and without a list of test scenes.
    pub shares_scenes: bool,
    /// Skipped scenes and frames.
    pub report: SkipReport,
}

impl OpenedSource {
    /// The frames that training may read: all, or without one in `hold_out` where both splits are the same scenes.
    pub fn training_source(&self, hold_out: usize) -> Arc<dyn SceneSource> {
        if self.shares_scenes && hold_out > 0 {
            Arc::new(SceneSubset::without_held_out(self.source.clone(), hold_out))
        } else {
            self.source.clone()
        }
    }
}

/// Opens one split of a data set on disk: `root/train` or `root/test`, or `root` if it has neither. `root` may be a data
/// set, a single scene, or a `transforms.json` of any name.
///
/// Without split folders both splits are the same scenes, unless
/// [`FileOptions::test_scenes`](crate::sources::options::FileOptions::test_scenes) separates them.
///
/// # Errors
/// [`DataError::UnknownLayout`] for a folder without scenes, [`DataError::BadConfig`] for [`SourceKind::Synthetic`],
/// and the errors of the reader of the layout.
pub fn open_source(root: &DatasetRoot, split: Split, options: &SourceOptions) -> Result<OpenedSource, DataError> {
    scan_source(root, split, options, &mut |_, _| ())
}

/// Opens a data set as [`open_source`] does. `progress` is called while its chunks are examined for the filters: the first
/// opening of a large data set reads every chunk and can take minutes.
pub(crate) fn scan_source(
    root: &DatasetRoot,
    split: Split,
    options: &SourceOptions,
    progress: ScanProgress<'_>,
) -> Result<OpenedSource, DataError> {
    if options.kind == SourceKind::Synthetic {
        return Err(BadConfig::new("source", "synthetic", "use the layout of the folder, or auto").into());
    }
    let list = options.files.test_scenes.as_deref().map(TestScenes::read).transpose()?;
    // With an empty list, both splits are the same scenes.
    let list = list.filter(|list| list.num_scenes() > 0);
    let folder = SplitFolder::find(root, split)?;
    let list = list.as_ref();
    let (kind, (source, report)) = match folder.detect(options.kind)? {
        DetectedSource::Torch(kind) => (kind, folder.open_torch(kind, options, list, progress)?),
        DetectedSource::Photos(kind, scenes, report) => {
            (kind, folder.open_photos(kind, scenes, report, options, list)?)
        }
    };
    Ok(OpenedSource { source, kind, shares_scenes: !root.has_splits && list.is_none(), report })
}

/// A source with what it skipped.
type Opened = (Arc<dyn SceneSource>, SkipReport);

impl SplitFolder<'_> {
    fn open_torch(
        &self,
        kind: SourceKind,
        options: &SourceOptions,
        list: Option<&TestScenes>,
        progress: ScanProgress<'_>,
    ) -> Result<Opened, DataError> {
        let mut report = SkipReport::default();
        let index = if kind == SourceKind::Chunks {
            let index = read_index(&self.base.join("index.json"))?;
            report.notes.extend(note_unlisted(&self.base, &index)?);
            index
        } else {
            index_of_files(&self.base, &mut report)?
        };
        let keys: Vec<String> = index.keys().cloned().collect();
        let kept = self.divide(list, &keys, &mut report);
        let kept: HashSet<&str> =
            keys.iter().zip(kept).filter(|(_, kept)| *kept).map(|(key, _)| key.as_str()).collect();
        let is_kept = |key: &str| kept.contains(key);
        let num_chunks = index.values().collect::<HashSet<_>>().len();
        let caches = cache_folder().filter(|_| num_chunks >= MIN_CACHED_CHUNKS);
        let cache = caches.map(|caches| ChunkIndexCache::path(&caches, &self.base));
        let cache = cache.as_deref().map(|path| (path, progress));
        let (filters, reads_all) = (&options.filters, options.reads_chunks);
        let mut source = ChunkSource::of_index(&self.base, &index, is_kept, filters, reads_all, cache)?;
        if kind == SourceKind::Chunks {
            source.record_unlisted(&self.base, &index);
        }
        report.append(source.report.clone());
        Ok((Arc::new(source), report))
    }

    fn open_photos(
        &self,
        kind: SourceKind,
        scenes: Vec<SceneFolder>,
        mut report: SkipReport,
        options: &SourceOptions,
        list: Option<&TestScenes>,
    ) -> Result<Opened, DataError> {
        let mut scenes = if scenes.is_empty() { self.re10k_clips(options)? } else { scenes };
        let keys: Vec<String> = scenes.iter().map(|scene| scene.key.clone()).collect();
        let mut kept = self.divide(list, &keys, &mut report).into_iter();
        scenes.retain(|_| kept.next().unwrap_or_default());
        let is_dl3dv = kind == SourceKind::Dl3dv;
        let files = &options.files;
        let source_options = PhotoSourceOptions {
            photos: PhotoOptions {
                image_folder: files.image_folder.clone(),
                first_folders: if is_dl3dv { DL3DV_FOLDERS } else { &[] },
                min_size: options.min_size,
                poses_from: files.poses_from,
                undistort: files.undistort.unwrap_or(kind == SourceKind::Captures),
                background: options.background,
            },
            filters: options.filters.clone(),
            whole_scenes: (is_dl3dv || kind == SourceKind::Re10kTxt) && !files.keep_incomplete,
            min_size: options.min_size,
            image_cache: options.image_cache.clone(),
        };
        let source = PhotoSource::open(scenes, &source_options)?;
        report.append(source.report.clone());
        Ok((Arc::new(source), report))
    }

    /// Returns the clips of RealEstate10K as text files, with the folders of their frames.
    fn re10k_clips(&self, options: &SourceOptions) -> Result<Vec<SceneFolder>, DataError> {
        let names = file_names(&self.base)?;
        let split = self.split.to_string();
        let folders: Vec<PathBuf> = if let Some(frames) = &options.files.frames {
            vec![frames.clone(), frames.join(&split)]
        } else {
            let above = self.base.parent().unwrap_or(&self.base);
            let frames = [self.root.path.join("frames"), above.join("frames")];
            let frames = frames.iter().flat_map(|frames| [frames.clone(), frames.join(&split)]);
            std::iter::once(self.base.clone()).chain(frames).collect()
        };
        let clip = |name: &String| {
            let key = name.strip_suffix(".txt")?;
            let mut candidates = folders.iter().map(|folder| folder.join(key));
            let frames =
                candidates.find(|frames| frames.is_dir()).unwrap_or_else(|| self.root.path.join("frames").join(key));
            Some(SceneFolder {
                key: key.into(),
                files: SceneFiles::Re10kText { cameras: self.base.join(name), frames },
            })
        };
        Ok(names.iter().filter_map(clip).collect())
    }

    /// Returns which of the keys belong to the split; adds the others to the report.
    fn divide(&self, list: Option<&TestScenes>, keys: &[String], report: &mut SkipReport) -> Vec<bool> {
        let Some(list) = list else { return vec![true; keys.len()] };
        let (kept, divided) = list.divide(keys, self.split, !self.root.has_splits);
        report.append(divided);
        kept
    }
}
