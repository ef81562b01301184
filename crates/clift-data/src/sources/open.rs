//! Opening data sets on disk in any layout.

use std::collections::HashSet;
use std::path::PathBuf;
use std::sync::Arc;

use crate::error::DataError;
use crate::files::listing::file_names;
use crate::scene_source::{SceneSource, Split};
use crate::skip_report::SkipReport;
use crate::sources::chunks::chunk_source::ChunkSource;
use crate::sources::chunks::index::{index_of_files, note_unlisted, read_index};
use crate::sources::chunks::index_cache::ChunkIndexCache;
use crate::sources::chunks::table::ScanProgress;
use crate::sources::dataset_root::{DatasetRoot, SplitFolder};
use crate::sources::kind::SourceKind;
use crate::sources::options::SourceOptions;
use crate::sources::photos::photo::PhotoOptions;
use crate::sources::photos::photo_source::PhotoSource;
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
/// set, a single scene, or a `transforms.json` of any name. With filters, every chunk is read once: of a large data
/// set the first opening can take a minute, in which `progress` is called.
///
/// Without split folders both splits are the same scenes, unless
/// [`FileOptions::test_scenes`](crate::sources::options::FileOptions::test_scenes) separates them.
///
/// # Errors
/// [`DataError::UnknownLayout`] for a folder without scenes, [`DataError::BadConfig`] for [`SourceKind::Synthetic`],
/// and the errors of the reader of the layout.
pub fn open_source(
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
    let (kind, scenes, mut report) = folder.detect(options.kind)?;
    let source = if matches!(kind, SourceKind::Chunks | SourceKind::Scenes) {
        folder.open_torch(kind, options, list.as_ref(), &mut report, progress)?
    } else {
        folder.open_photos(kind, scenes, options, list.as_ref(), &mut report)?
    };
    Ok(OpenedSource { source, kind, shares_scenes: !root.has_splits && list.is_none(), report })
}

impl SplitFolder<'_> {
    fn open_torch(
        &self,
        kind: SourceKind,
        options: &SourceOptions,
        list: Option<&TestScenes>,
        report: &mut SkipReport,
        progress: ScanProgress<'_>,
    ) -> Result<Arc<dyn SceneSource>, DataError> {
        let mut index = if kind == SourceKind::Chunks {
            let index = read_index(&self.base.join("index.json"))?;
            report.notes.extend(note_unlisted(&self.base, &index)?);
            index
        } else {
            index_of_files(&self.base, report, progress)?
        };
        let keys: Vec<String> = index.keys().cloned().collect();
        let mut kept = self.divide(list, &keys, report).into_iter();
        index.retain(|_, _| kept.next().unwrap_or_default());
        let num_chunks = index.values().collect::<HashSet<_>>().len();
        let caches = cache_folder().filter(|_| num_chunks >= MIN_CACHED_CHUNKS);
        let cache = caches.map(|caches| ChunkIndexCache::path(&caches, &self.base));
        let (filters, reads_all) = (&options.filters, options.reads_chunks);
        let source = ChunkSource::of_index(&self.base, &index, filters, reads_all, cache.as_deref(), progress)?;
        report.append(source.report.clone());
        Ok(Arc::new(source))
    }

    fn open_photos(
        &self,
        kind: SourceKind,
        mut scenes: Vec<SceneFolder>,
        options: &SourceOptions,
        list: Option<&TestScenes>,
        report: &mut SkipReport,
    ) -> Result<Arc<dyn SceneSource>, DataError> {
        if kind == SourceKind::Re10kTxt {
            scenes = self.re10k_clips(options)?;
        }
        let keys: Vec<String> = scenes.iter().map(|scene| scene.key.clone()).collect();
        let mut kept = self.divide(list, &keys, report).into_iter();
        scenes.retain(|_| kept.next().unwrap_or_default());
        let is_dl3dv = kind == SourceKind::Dl3dv;
        let files = &options.files;
        let photos = PhotoOptions {
            image_folder: files.image_folder.clone(),
            first_folders: if is_dl3dv { DL3DV_FOLDERS } else { &[] },
            undistort: files.undistort.unwrap_or(kind == SourceKind::Captures),
            min_size: options.min_size,
            background: options.background,
            poses_from: files.poses_from,
            filters: options.filters.clone(),
            whole_scenes: is_dl3dv || kind == SourceKind::Re10kTxt,
            caches_photos: options.caches_photos,
        };
        let source = PhotoSource::open(scenes, &photos)?;
        report.append(source.report.clone());
        Ok(Arc::new(source))
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
            let files = SceneFiles::Re10kText { cameras: self.base.join(name), frames };
            Some(SceneFolder { key: key.into(), files })
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

/// Returns `clift` in the user's folder for caches; `None` if the environment has none.
fn cache_folder() -> Option<PathBuf> {
    let variable = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    let home = || variable("HOME").map(|home| home.join(".cache"));
    let caches = variable("XDG_CACHE_HOME").or_else(|| variable("LOCALAPPDATA")).or_else(home)?;
    Some(caches.join("clift"))
}
