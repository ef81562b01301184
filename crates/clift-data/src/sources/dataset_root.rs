//! The root of a data set: its split folders, and the kind of their scenes.

use std::path::{Path, PathBuf};

use clift_core::{first_few, plural};

use crate::error::DataError;
use crate::files::listing::{file_names, has_ending};
use crate::scene_source::Split;
use crate::skip_report::SkipReport;
use crate::sources::keys::is_dl3dv_key;
use crate::sources::kind::SourceKind;
use crate::sources::photos::image_folder::num_images;
use crate::sources::photos::re10k_text::looks_like_re10k;
use crate::sources::photos::scene_folder::{SceneFiles, SceneFolder, find_scenes, scene_in, transforms_in};

/// The folder, or the file of a single scene, that a data set is opened from.
pub struct DatasetRoot {
    /// Path of the root.
    pub path: PathBuf,
    /// Whether training and test scenes lie in folders of their own, `train/` and `test/`: not if only one of these is a
    /// capture, such as `train` of Tanks and Temples.
    pub has_splits: bool,
}

impl DatasetRoot {
    /// Finds a data set and its split folders.
    pub fn find(path: &Path) -> Result<Self, DataError> {
        std::fs::metadata(path).map_err(DataError::io("opening the data", path))?;
        let mut splits = [Split::Train, Split::Test].map(|split| path.join(split.to_string())).to_vec();
        splits.retain(|split| split.is_dir());
        let num_captures = splits.iter().filter(|split| scene_in(split).is_some()).count();
        let is_split = scene_in(path).is_none() && (num_captures == 0 || num_captures == 2);
        Ok(Self { path: path.to_owned(), has_splits: !splits.is_empty() && is_split })
    }
}

/// The folder of one split; without split folders, the root.
pub(crate) struct SplitFolder<'a> {
    pub root: &'a DatasetRoot,
    pub base: PathBuf,
    pub split: Split,
}

impl<'a> SplitFolder<'a> {
    pub fn find(root: &'a DatasetRoot, split: Split) -> Result<Self, DataError> {
        let base = if root.has_splits { root.path.join(split.to_string()) } else { root.path.clone() };
        let folder = Self { root, base, split };
        if folder.base.exists() {
            return Ok(folder);
        }
        Err(folder.no_scenes(&format!("no folder {split}/ beside the other split")))
    }

    /// Finds the requested kind, or detects it. Folders of photos are returned, with a report of those that are skipped; those
    /// of other layouts are not.
    pub fn detect(&self, asked: SourceKind) -> Result<(SourceKind, Vec<SceneFolder>, SkipReport), DataError> {
        let base = &self.base;
        if base.is_file() {
            let kind = if asked == SourceKind::Auto { SourceKind::Captures } else { asked };
            return Ok((kind, vec![SceneFolder::of_file(base)], SkipReport::default()));
        }
        let names = file_names(base)?;
        let has_torch = names.iter().any(|name| has_ending(name, "torch"));
        let has_text = || {
            let mut texts = names.iter().filter(|name| has_ending(name, "txt")).take(8);
            texts.any(|name| looks_like_re10k(&base.join(name)))
        };
        let flat = match asked {
            SourceKind::Auto if names.iter().any(|name| name == "index.json") => Some(SourceKind::Chunks),
            SourceKind::Auto if has_torch => Some(SourceKind::Scenes),
            SourceKind::Auto => has_text().then_some(SourceKind::Re10kTxt),
            SourceKind::Chunks => Some(asked),
            SourceKind::Scenes if has_torch => Some(asked),
            SourceKind::Scenes => return Err(self.no_scenes("expected .torch files")),
            SourceKind::Re10kTxt if has_text() => Some(asked),
            SourceKind::Re10kTxt => return Err(self.no_scenes("expected .txt files of RealEstate10K")),
            _ => None,
        };
        if let Some(kind) = flat {
            return Ok((kind, Vec::new(), SkipReport::default()));
        }
        let (mut scenes, without_cameras) = find_scenes(base)?;
        let kind = if asked == SourceKind::Auto { self.recognise(&scenes)? } else { asked };
        let mut report = SkipReport::default();
        scenes.retain(|scene| {
            let is_of_kind = kind != SourceKind::Dl3dv || matches!(scene.files, SceneFiles::Transforms(_));
            if !is_of_kind {
                report.num_scenes += 1;
                report.skip(&scene.key, format!("with cameras in another format than {kind}"));
            }
            is_of_kind
        });
        if scenes.is_empty() {
            return Err(self.no_scenes(match asked {
                SourceKind::Auto => {
                    "expected index.json with chunks, .torch files, .txt files of RealEstate10K, or folders with a \
                     transforms.json or a COLMAP model, at most three levels down"
                }
                SourceKind::Dl3dv => "expected folders with a transforms.json",
                _ => "expected folders with a transforms.json or a COLMAP model",
            }));
        }
        report.num_scenes += without_cameras.len();
        for key in without_cameras {
            let lacks = if is_dl3dv_key(&key) { "transforms.json" } else { "cameras" };
            report.skip(key, format!("without {lacks}"));
        }
        Ok((kind, scenes, report))
    }

    /// Returns the kind of scenes in folders. DL3DV differs in lenses, incomplete scenes and test scenes: one stray folder must
    /// not decide the kind.
    fn recognise(&self, scenes: &[SceneFolder]) -> Result<SourceKind, DataError> {
        let num_dl3dv = scenes.iter().filter(|scene| scene.is_dl3dv()).count();
        match scenes.iter().find(|scene| !scene.is_dl3dv()) {
            None => Ok(SourceKind::Dl3dv),
            Some(other) if num_dl3dv > 0 => {
                let what = format!(
                    "{num_dl3dv} of {} scenes are DL3DV scenes by their names and transforms.json, and others, such as {}, \
                     are not: set data.source to \"dl3dv\" or \"captures\" for all scenes, or move them to separate \
                     folders",
                    scenes.len(),
                    other.key
                );
                Err(DataError::UnknownLayout { what, path: self.base.clone() })
            }
            Some(_) => Ok(SourceKind::Captures),
        }
    }

    /// Returns the error of a folder without scenes, with the data found instead.
    fn no_scenes(&self, what: &str) -> DataError {
        let mut parts = vec![what.to_owned()];
        let folders = [self.base.as_path(), self.root.path.as_path()];
        let files = folders.into_iter().map(transforms_in).find(|files| !files.is_empty());
        parts.extend(files.map(|files| {
            format!(
                "no transforms.json, but {}: open one of them by its path, or merge their frames into one \
                 transforms.json",
                first_few(&files)
            )
        }));
        let num_photos = num_images(&self.base);
        if num_photos > 0 {
            parts.push(format!(
                "{} without cameras: compute poses first, with COLMAP (images in DIR/images; `colmap \
                 automatic_reconstructor --workspace_path DIR --image_path DIR/images --dense 0`) or nerfstudio (`ns-process-data \
                 images --data PHOTOS --output-dir DIR`), then open DIR",
                plural(num_photos, "image")
            ));
        }
        let path = if self.base.exists() { self.base.clone() } else { self.root.path.clone() };
        DataError::UnknownLayout { what: parts.join("; "), path }
    }
}
