//! The root of a data set: its split folders, and the kind of their scenes.

use std::path::{Path, PathBuf};

use crate::error::DataError;
use crate::files::listing::{file_names, has_ending};
use crate::scene_source::Split;
use crate::skip_report::{SkipReport, first_few, plural};
use crate::sources::keys::is_dl3dv_key;
use crate::sources::kind::SourceKind;
use crate::sources::photos::image_folder::num_images;
use crate::sources::photos::re10k_text::looks_like_re10k;
use crate::sources::photos::scene_folder::{
    FoundScenes, SceneFiles, SceneFolder, find_scenes, scene_in, transforms_in,
};

/// The folder, or the file of a single scene, that a data set is opened from.
pub struct DatasetRoot {
    /// Path of the root.
    pub path: PathBuf,
    /// Whether training and test scenes lie in folders of their own, `train/` and `test/`.
    ///
    /// A capture may have such a name as well, such as `train` of Tanks and Temples. A capture counts as a split only if
    /// the other split is a capture too and no third capture lies beside them.
    pub has_splits: bool,
}

impl DatasetRoot {
    /// Finds a data set and its split folders.
    pub fn find(path: &Path) -> Result<Self, DataError> {
        std::fs::metadata(path).map_err(DataError::io("opening the data", path))?;
        Ok(Self { path: path.to_owned(), has_splits: has_splits(path) })
    }
}

fn has_splits(root: &Path) -> bool {
    let splits = [Split::Train, Split::Test].map(|split| split.to_string());
    let present: Vec<&String> = splits.iter().filter(|split| root.join(split).is_dir()).collect();
    if present.is_empty() || scene_in(root).is_some() {
        return false;
    }
    let is_capture = |name: &String| scene_in(&root.join(name)).is_some_and(|files| files.is_capture());
    if !present.iter().any(|split| is_capture(split)) {
        return true;
    }
    let names = file_names(root).unwrap_or_default();
    present.len() == splits.len() && !names.iter().any(|name| !splits.contains(name) && is_capture(name))
}

/// The scenes detected in a folder; for photos, with a report of the skipped ones.
pub(crate) enum DetectedSource {
    Torch(SourceKind),
    Photos(SourceKind, Vec<SceneFolder>, SkipReport),
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
        Err(folder.no_scenes(&format!("no folder {split}/ beside the other split"), &[]))
    }

    /// Finds the scenes of the requested kind, or of the detected kind.
    pub fn detect(&self, asked: SourceKind) -> Result<DetectedSource, DataError> {
        let base = &self.base;
        if base.is_file() {
            let kind = if asked == SourceKind::Auto { SourceKind::Captures } else { asked };
            return Ok(DetectedSource::Photos(kind, vec![SceneFolder::of_file(base)], SkipReport::default()));
        }
        let names = file_names(base)?;
        let has_torch = names.iter().any(|name| has_ending(name, "torch"));
        match asked {
            SourceKind::Chunks => return Ok(DetectedSource::Torch(SourceKind::Chunks)),
            SourceKind::Scenes if has_torch => return Ok(DetectedSource::Torch(SourceKind::Scenes)),
            SourceKind::Scenes => return Err(self.no_scenes("expected .torch files", &[])),
            SourceKind::Auto if names.iter().any(|name| name == "index.json") => {
                return Ok(DetectedSource::Torch(SourceKind::Chunks));
            }
            SourceKind::Auto if has_torch => return Ok(DetectedSource::Torch(SourceKind::Scenes)),
            _ => {}
        }
        if matches!(asked, SourceKind::Auto | SourceKind::Re10kTxt) {
            let texts: Vec<&String> = names.iter().filter(|name| has_ending(name, "txt")).collect();
            if scene_in(base).is_none() && texts.iter().take(8).any(|name| looks_like_re10k(&base.join(name))) {
                return Ok(DetectedSource::Photos(SourceKind::Re10kTxt, Vec::new(), SkipReport::default()));
            }
        }
        let FoundScenes { mut scenes, others, notes, without_cameras } = find_scenes(base)?;
        let kind = if asked == SourceKind::Auto { self.recognise(&scenes)? } else { asked };
        let mut report = SkipReport { notes, ..SkipReport::default() };
        scenes.retain(|scene| {
            let is_of_kind = match kind {
                SourceKind::Re10kTxt => matches!(scene.files, SceneFiles::Re10kText { .. }),
                SourceKind::Dl3dv => matches!(scene.files, SceneFiles::Transforms(_)),
                _ => true,
            };
            if !is_of_kind {
                report.num_scenes += 1;
                report.skip(&scene.key, format!("with cameras in another format than {kind}"));
            }
            is_of_kind
        });
        if scenes.is_empty() {
            let what = match asked {
                SourceKind::Auto => {
                    "expected index.json with chunks, .torch files, .txt files of RealEstate10K, or folders with a \
                     transforms.json or a COLMAP model, at most three levels down"
                }
                SourceKind::Re10kTxt => "expected .txt files of RealEstate10K",
                SourceKind::Dl3dv => "expected folders with a transforms.json",
                _ => "expected folders with a transforms.json or a COLMAP model",
            };
            return Err(self.no_scenes(what, &others));
        }
        report.num_scenes += without_cameras.len();
        for key in without_cameras {
            let lacks = if is_dl3dv_key(&key) { "transforms.json" } else { "cameras" };
            report.skip(key, format!("without {lacks}"));
        }
        if !others.is_empty() {
            report.notes.push(format!("not opened, other data sets: {}", first_few(&others)));
        }
        Ok(DetectedSource::Photos(kind, scenes, report))
    }

    fn recognise(&self, scenes: &[SceneFolder]) -> Result<SourceKind, DataError> {
        if scenes.iter().all(|scene| matches!(scene.files, SceneFiles::Re10kText { .. })) {
            return Ok(SourceKind::Re10kTxt);
        }
        // DL3DV differs in lenses, incomplete scenes and test scenes: one stray folder must not decide the kind.
        match scenes.iter().find(|scene| !scene.is_dl3dv()) {
            None => Ok(SourceKind::Dl3dv),
            Some(other) if scenes.iter().any(SceneFolder::is_dl3dv) => {
                let num_dl3dv = scenes.iter().filter(|scene| scene.is_dl3dv()).count();
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
    fn no_scenes(&self, what: &str, others: &[String]) -> DataError {
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
        if !others.is_empty() {
            parts.push(format!("other data sets below it, to be opened separately: {}", first_few(others)));
        }
        let path = if self.base.exists() { self.base.clone() } else { self.root.path.clone() };
        DataError::UnknownLayout { what: parts.join("; "), path }
    }
}
