//! Which half of a root is meant, and the layout of what is in it.

use std::path::{Path, PathBuf};

use crate::error::DataError;
use crate::layout::Layout;
use crate::ledger::{Ledger, some_of};
use crate::picture_folder::{file_names, has_ending};
use crate::re10k_text::looks_like_re10k;
use crate::scene_folder::{FoundScenes, SceneFiles, SceneFolder, find_scenes, scene_in, transforms_in};
use crate::split::Split;

/// A folder of scenes: a root, or its half.
pub(crate) struct Place<'a> {
    pub root: &'a Path,
    pub base: PathBuf,
    pub split: Split,
    pub has_splits: bool,
}

/// What is in a folder; of photos, with what was left out or not looked at.
pub(crate) enum Found {
    Torch(Layout),
    Photos(Layout, Vec<SceneFolder>, Ledger),
}

/// Whether training and test scenes lie in folders of their own, `train/` and `test/`.
///
/// A capture may have such a name too, as `train` of Tanks and Temples has: then it is no half, unless the other half is
/// a capture as well and no third is beside them.
pub fn has_halves(root: &Path) -> bool {
    let halves = [Split::Train, Split::Test].map(|split| split.to_string());
    let there: Vec<&String> = halves.iter().filter(|half| root.join(half).is_dir()).collect();
    if there.is_empty() || scene_in(root).is_some() {
        return false;
    }
    let is_capture = |name: &String| {
        matches!(scene_in(&root.join(name)), Some(SceneFiles::Transforms(_) | SceneFiles::Colmap { .. }))
    };
    if !there.iter().any(|half| is_capture(half)) {
        return true;
    }
    let names = file_names(root).unwrap_or_default();
    there.len() == halves.len() && !names.iter().any(|name| !halves.contains(name) && is_capture(name))
}

impl<'a> Place<'a> {
    /// Finds the half of `root` that is meant, or all of it.
    ///
    /// # Errors
    /// [`DataError::Io`] for a root that is not there, [`DataError::UnknownLayout`] for a half that is not.
    pub fn find(root: &'a Path, split: Split) -> Result<Self, DataError> {
        std::fs::metadata(root).map_err(DataError::io("opening the data", root))?;
        let has_splits = has_halves(root);
        let base = if has_splits { root.join(split.to_string()) } else { root.to_owned() };
        let place = Self { root, base, split, has_splits };
        if place.base.exists() {
            return Ok(place);
        }
        Err(place.nothing(&format!("there is no folder {split}/ beside the other split"), &[]))
    }

    /// Finds the scenes of the layout asked for, or of the first that is recognised.
    ///
    /// # Errors
    /// [`DataError::UnknownLayout`] for a folder without scenes, and for one with scenes of DL3DV among others.
    pub fn scenes(&self, asked: Layout) -> Result<Found, DataError> {
        let base = &self.base;
        if base.is_file() {
            let layout = if asked == Layout::Auto { Layout::Captures } else { asked };
            return Ok(Found::Photos(layout, vec![SceneFolder::of_file(base)], Ledger::default()));
        }
        let names = file_names(base)?;
        let has_torch = names.iter().any(|name| has_ending(name, "torch"));
        match asked {
            Layout::Chunks => return Ok(Found::Torch(Layout::Chunks)),
            Layout::Scenes if has_torch => return Ok(Found::Torch(Layout::Scenes)),
            Layout::Scenes => return Err(self.nothing("expected .torch files", &[])),
            Layout::Auto if names.iter().any(|name| name == "index.json") => return Ok(Found::Torch(Layout::Chunks)),
            Layout::Auto if has_torch => return Ok(Found::Torch(Layout::Scenes)),
            _ => {}
        }
        if matches!(asked, Layout::Auto | Layout::Re10kTxt) {
            let texts: Vec<&String> = names.iter().filter(|name| has_ending(name, "txt")).collect();
            let is_scene = scene_in(base).is_some();
            if !is_scene && texts.iter().take(8).any(|name| looks_like_re10k(&base.join(name))) {
                return Ok(Found::Photos(Layout::Re10kTxt, Vec::new(), Ledger::default()));
            }
        }
        let FoundScenes { mut scenes, others, notes } = find_scenes(base)?;
        let layout = if asked == Layout::Auto { self.recognise(&scenes)? } else { asked };
        let mut ledger = Ledger { notes, ..Ledger::default() };
        scenes.retain(|scene| {
            let is_of_layout = match layout {
                Layout::Re10kTxt => matches!(scene.files, SceneFiles::Re10kText { .. }),
                Layout::Dl3dv => matches!(scene.files, SceneFiles::Transforms(_)),
                _ => true,
            };
            if !is_of_layout {
                ledger.num_scenes += 1;
                ledger.skip(&scene.key, format!("with cameras in another form than {layout} has"));
            }
            is_of_layout
        });
        if scenes.is_empty() {
            let what = match asked {
                Layout::Auto => {
                    "looked for index.json with chunks, .torch files, RealEstate10K's .txt files, and for folders with \
                     a transforms.json or a COLMAP model, three levels down"
                }
                Layout::Re10kTxt => "expected RealEstate10K's .txt files",
                Layout::Dl3dv => "expected folders with a transforms.json",
                _ => "expected folders with a transforms.json or a COLMAP model",
            };
            return Err(self.nothing(what, &others));
        }
        if !others.is_empty() {
            ledger.notes.push(format!("not opened, each being data of its own: {}", some_of(&others)));
        }
        Ok(Found::Photos(layout, scenes, ledger))
    }

    /// The layout that all of these scenes have.
    fn recognise(&self, scenes: &[SceneFolder]) -> Result<Layout, DataError> {
        if scenes.iter().all(|scene| matches!(scene.files, SceneFiles::Re10kText { .. })) {
            return Ok(Layout::Re10kTxt);
        }
        // Lenses, incomplete scenes and scenes kept for testing are treated in another way, so that one stray folder
        // must not decide over all the others.
        match scenes.iter().find(|scene| !scene.is_dl3dv()) {
            None => Ok(Layout::Dl3dv),
            Some(other) if scenes.iter().any(SceneFolder::is_dl3dv) => {
                let num_dl3dv = scenes.iter().filter(|scene| scene.is_dl3dv()).count();
                let what = format!(
                    "{num_dl3dv} of {} scenes are DL3DV's by their names and transforms.json, and others, such as {}, \
                     are not: say with data.source whether all are to be read as \"dl3dv\" or as \"captures\", or keep \
                     them in folders of their own",
                    scenes.len(),
                    other.key
                );
                Err(DataError::UnknownLayout { what, path: self.base.clone() })
            }
            Some(_) => Ok(Layout::Captures),
        }
    }

    /// The error for a folder without scenes, with what is there instead.
    fn nothing(&self, what: &str, others: &[String]) -> DataError {
        let mut parts = vec![what.to_owned()];
        let folders = [&self.base, self.root];
        let files = folders.into_iter().map(transforms_in).find(|files| !files.is_empty());
        parts.extend(files.map(|files| {
            format!(
                "there is no transforms.json, but {}: open one by its path, or write the frames of all into a \
                 transforms.json",
                some_of(&files)
            )
        }));
        if !others.is_empty() {
            parts.push(format!("below it there is other data, to be opened by itself: {}", some_of(others)));
        }
        let what = parts.join("; ");
        let path = if self.base.exists() { self.base.clone() } else { self.root.to_owned() };
        DataError::UnknownLayout { what, path }
    }
}
