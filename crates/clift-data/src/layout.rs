//! Every layout that posed photos come in, recognised by what is in a folder.

use std::collections::HashSet;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::chunk::ChunkSource;
use crate::chunk_index::{index_of_files, note_unlisted, read_index};
use crate::clip::SceneSource;
use crate::error::DataError;
use crate::filters::SceneFilters;
use crate::ledger::Ledger;
use crate::photo_source::{PhotoSource, PhotoSourceOptions};
use crate::picture_folder::file_names;
use crate::place::{Found, Place};
use crate::scene_folder::{SceneFiles, SceneFolder};
use crate::split::Split;
use crate::test_scenes::{KEPT_AND_ABSENT, TestScenes};
use crate::transforms::PhotoOptions;

/// Folders that DL3DV's pictures are in, in the order they are preferred: 480 x 270, then larger.
const DL3DV_FOLDERS: &[&str] = &["images_8", "images_4", "images_2"];

/// The note of data that is not divided: of no interest where a single half is asked for.
pub const SAME_SCENES: &str =
    "no train/ and test/ folders and no test scenes in a list: both halves are the same scenes";

/// How scenes lie on disk.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Layout {
    /// Whichever of the others is recognised.
    #[default]
    Auto,
    /// pixelSplat's and DepthSplat's: `NNNNNN.torch` files of many scenes with an `index.json`.
    Chunks,
    /// The reference's: a `.torch` file per scene.
    Scenes,
    /// RealEstate10K's text files of cameras, and folders of frames.
    Re10kTxt,
    /// DL3DV's folders: `transforms.json` and `images_8` or `images_4`, by hash. Lens distortion is ignored, as the
    /// published numbers do.
    Dl3dv,
    /// Own captures: `transforms.json` or a COLMAP model, a scene per folder. Lens distortion is undone.
    Captures,
}

impl fmt::Display for Layout {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Auto => "auto",
            Self::Chunks => "chunks",
            Self::Scenes => "scenes",
            Self::Re10kTxt => "re10k_txt",
            Self::Dl3dv => "dl3dv",
            Self::Captures => "captures",
        })
    }
}

/// Where the parts of a layout are, if not where they are expected.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FileOptions {
    /// Keys of the scenes kept for testing and out of training: an evaluation index, a JSON list or a key per line.
    pub test_scenes: Option<PathBuf>,
    /// Folder of the frames of `re10k_txt`, with a folder per key in it or in `train/` and `test/` below it.
    pub frames: Option<PathBuf>,
    /// Folder of the pictures within a scene of `dl3dv` or `captures`, such as `images_4`.
    pub image_folder: Option<String>,
    /// Whether lens distortion is undone; by default in `captures` alone.
    pub undistort: Option<bool>,
    /// Whether scenes of `re10k_txt` and `dl3dv` with missing pictures are used without these frames. Positions of
    /// frames then differ from those that published indices count.
    pub keep_incomplete: bool,
}

/// What is opened, and which part of it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LayoutOptions {
    /// The layout, or `Auto`.
    pub layout: Layout,
    /// Which scenes are used.
    pub filters: SceneFilters,
    /// Where parts are.
    pub files: FileOptions,
    /// Fewest columns and rows of a usable picture; for layouts of one file per frame.
    pub min_size: [usize; 2],
    /// Whether every chunk is looked into even where no filter asks for it: what cannot be read, and what `index.json`
    /// does not name, is then in the ledger.
    pub reads_chunks: bool,
}

/// Scenes that were opened.
pub struct Opened {
    /// The scenes.
    pub source: Arc<dyn SceneSource>,
    /// What was left out, and why.
    pub ledger: Ledger,
    /// The layout that was found.
    pub layout: Layout,
    /// Whether training and test scenes lie in folders of their own, `train/` and `test/`.
    pub has_splits: bool,
}

/// Opens one half of a data set: what is in `root/train` or `root/test`, or in `root` where it has neither. `root` may
/// be a data set, a single scene, or a `transforms.json` of any name.
///
/// Without folders of their own both halves are the same scenes (the ledger notes it), unless
/// [`FileOptions::test_scenes`] divides them.
///
/// # Errors
/// [`DataError::UnknownLayout`] for a folder without scenes; what opening the layout gives.
pub fn open_layout(
    root: &Path,
    split: Split,
    options: &LayoutOptions,
) -> Result<(Arc<dyn SceneSource>, Ledger), DataError> {
    Opened::open(root, split, options).map(|opened| (opened.source, opened.ledger))
}

impl Opened {
    /// Does [`open_layout`], and says what it found.
    pub fn open(root: &Path, split: Split, options: &LayoutOptions) -> Result<Self, DataError> {
        let list = options.files.test_scenes.as_deref().map(TestScenes::read).transpose()?;
        // An empty list says that no scene is kept for testing: both halves are then the same.
        let list = list.filter(|list| list.num_scenes() > 0);
        let place = Place::find(root, split)?;
        let mut opened = match place.scenes(options.layout)? {
            Found::Torch(layout) => place.open_torch(layout, options, list.as_ref())?,
            Found::Photos(layout, scenes, ledger) => {
                place.open_photos(layout, scenes, ledger, options, list.as_ref())?
            }
        };
        if !opened.has_splits && list.is_none() {
            opened.ledger.notes.push(SAME_SCENES.into());
        }
        Ok(opened)
    }
}

impl Place<'_> {
    fn open_torch(
        &self,
        layout: Layout,
        options: &LayoutOptions,
        list: Option<&TestScenes>,
    ) -> Result<Opened, DataError> {
        let mut ledger = Ledger::default();
        let index = if layout == Layout::Chunks {
            let index = read_index(&self.base.join("index.json"))?;
            ledger.notes.extend(note_unlisted(&self.base, &index)?);
            index
        } else {
            index_of_files(&self.base, &mut ledger)?
        };
        let keys: Vec<String> = index.keys().cloned().collect();
        let kept = self.divide(list, &keys, options, &mut ledger);
        let kept: HashSet<&str> =
            keys.iter().zip(kept).filter(|(_, kept)| *kept).map(|(key, _)| key.as_str()).collect();
        let is_kept = |key: &str| kept.contains(key);
        let mut source = ChunkSource::of_index(&self.base, &index, is_kept, &options.filters, options.reads_chunks)?;
        if layout == Layout::Chunks {
            source.tell_unlisted(&self.base, &index);
        }
        append(&mut ledger, source.ledger());
        Ok(Opened { source: Arc::new(source), ledger, layout, has_splits: self.has_splits })
    }

    fn open_photos(
        &self,
        layout: Layout,
        scenes: Vec<SceneFolder>,
        mut ledger: Ledger,
        options: &LayoutOptions,
        list: Option<&TestScenes>,
    ) -> Result<Opened, DataError> {
        let is_text = layout == Layout::Re10kTxt;
        let mut scenes = if scenes.is_empty() { self.re10k_clips(options)? } else { scenes };
        let keys: Vec<String> = scenes.iter().map(|scene| scene.key.clone()).collect();
        let mut kept = self.divide(list, &keys, options, &mut ledger).into_iter();
        scenes.retain(|_| kept.next().unwrap_or_default());
        let is_dl3dv = layout == Layout::Dl3dv;
        let files = &options.files;
        let source_options = PhotoSourceOptions {
            photos: PhotoOptions {
                image_folder: files.image_folder.clone(),
                first_folders: if is_dl3dv { DL3DV_FOLDERS } else { &[] },
                undistort: files.undistort.unwrap_or(layout == Layout::Captures),
            },
            filters: options.filters.clone(),
            whole_scenes: (is_dl3dv || is_text) && !files.keep_incomplete,
            min_size: options.min_size,
        };
        let source = PhotoSource::open(scenes, &source_options)?;
        append(&mut ledger, source.ledger());
        Ok(Opened { source: Arc::new(source), ledger, layout, has_splits: self.has_splits })
    }

    /// Clips of RealEstate10K as text files, and where their frames are.
    fn re10k_clips(&self, options: &LayoutOptions) -> Result<Vec<SceneFolder>, DataError> {
        let mut names = file_names(&self.base)?;
        names.sort_unstable();
        let split = self.split.to_string();
        let folders: Vec<PathBuf> = if let Some(frames) = &options.files.frames {
            vec![frames.clone(), frames.join(&split)]
        } else {
            let above = self.base.parent().unwrap_or(&self.base);
            let frames = [self.root.join("frames"), above.join("frames")];
            let frames = frames.iter().flat_map(|frames| [frames.clone(), frames.join(&split)]);
            std::iter::once(self.base.clone()).chain(frames).collect()
        };
        let clip = |name: &String| {
            let key = name.strip_suffix(".txt")?;
            let mut places = folders.iter().map(|folder| folder.join(key));
            let frames = places.find(|frames| frames.is_dir()).unwrap_or_else(|| self.root.join("frames").join(key));
            let files = SceneFiles::Re10kText { cameras: self.base.join(name), frames };
            Some(SceneFolder { key: key.into(), files })
        };
        Ok(names.iter().filter_map(clip).collect())
    }

    /// Which of the keys belong to the split; the rest goes into the ledger.
    fn divide(
        &self,
        list: Option<&TestScenes>,
        keys: &[String],
        options: &LayoutOptions,
        ledger: &mut Ledger,
    ) -> Vec<bool> {
        let Some(list) = list else { return vec![true; keys.len()] };
        let (kept, mut divided) = list.divide(keys, self.split, !self.has_splits);
        if self.has_splits && self.split == Split::Train && !divided.skips.is_empty() {
            let there = TestScenes::of_keys(&self.test_keys(options).unwrap_or_default());
            let absent = divided.skips.iter_mut().filter(|skip| !there.contains(&skip.key));
            absent.for_each(|skip| skip.reason = KEPT_AND_ABSENT.into());
        }
        append(ledger, &divided);
        kept
    }

    /// Keys of the scenes in `test/`.
    fn test_keys(&self, options: &LayoutOptions) -> Result<Vec<String>, DataError> {
        let place = Place::find(self.root, Split::Test)?;
        Ok(match place.scenes(options.layout)? {
            Found::Torch(Layout::Chunks) => read_index(&place.base.join("index.json"))?.into_keys().collect(),
            Found::Torch(_) => index_of_files(&place.base, &mut Ledger::default())?.into_keys().collect(),
            Found::Photos(_, scenes, _) => {
                let scenes = if scenes.is_empty() { place.re10k_clips(options)? } else { scenes };
                scenes.into_iter().map(|scene| scene.key).collect()
            }
        })
    }
}

fn append(ledger: &mut Ledger, more: &Ledger) {
    ledger.num_scenes += more.num_scenes;
    ledger.skips.extend_from_slice(&more.skips);
    ledger.frames.extend_from_slice(&more.frames);
    ledger.notes.extend_from_slice(&more.notes);
}
