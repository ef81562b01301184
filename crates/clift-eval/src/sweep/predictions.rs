//! Pictures that another system drew of the targets, scored like our own.
//!
//! They lie in `FOLDER/<scene>/<target frame>.png`, the frame in six digits, or in a folder `color` of the scene's, as
//! pixelSplat writes them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clift_data::Clip;
use image::{DynamicImage, ImageReader, Limits};

use crate::config::method::{Method, MethodName};
use crate::error::EvalError;
use crate::statistics::eval_results::EvalResults;
use crate::statistics::view_metrics::{EvalKey, ViewMetrics};
use crate::sweep::view_scorer::ViewScorer;

/// Another system with its pictures.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ExternalMethod {
    /// What it is called in tables and plots.
    pub name: MethodName,
    /// Folder of its pictures.
    pub folder: PathBuf,
    /// Bytes it keeps of a scene, to stand beside scene files.
    pub data_bytes: Option<u64>,
}

/// The views of a scene as another system drew them.
pub(crate) struct ScoredPredictions {
    pub setting: EvalKey,
    /// By view; those that are there.
    pub measured: BTreeMap<usize, ViewMetrics>,
    /// The pictures that are shown, by view: `height * width * 3` values of RGB.
    pub shown: BTreeMap<usize, Vec<f32>>,
}

impl ExternalMethod {
    /// How its views are made.
    pub const fn setting(&self) -> EvalKey {
        EvalKey::baseline(Method::System(self.name))
    }

    /// Measures the pictures of a scene's targets; those that are missing are noted.
    pub(crate) fn score(
        &self,
        clip: &Clip,
        scorer: &ViewScorer,
        rows: &[usize],
        into: &mut EvalResults,
    ) -> Result<ScoredPredictions, EvalError> {
        let setting = self.setting();
        let mut scored = ScoredPredictions { setting, measured: BTreeMap::new(), shown: BTreeMap::new() };
        for (view, &frame) in clip.target.frame_index.iter().enumerate() {
            let name = picture_name(&clip.key, frame);
            let Some(path) = self.find(&clip.key, frame) else {
                into.miss(self.name, name);
                continue;
            };
            let pixels = read_picture(&path, clip.target.height, clip.target.width)?;
            scored.measured.insert(view, scorer.measure(&pixels, view)?);
            if rows.contains(&view) {
                scored.shown.insert(view, pixels);
            }
        }
        if let Some(bytes) = self.data_bytes {
            into.add_scene_bytes(setting, bytes);
        }
        Ok(scored)
    }

    fn find(&self, key: &str, frame: usize) -> Option<PathBuf> {
        let scene = self.folder.join(file_name(key));
        let name = format!("{frame:06}.png");
        [scene.join(&name), scene.join("color").join(&name)].into_iter().find(|path| path.is_file())
    }
}

/// Where a picture is looked for, inside a system's folder.
pub fn picture_name(key: &str, frame: usize) -> String {
    format!("{}/{frame:06}.png", file_name(key))
}

/// A key as a file name: anything but letters, digits, `-`, `_` and `.` becomes `_`, and so does a leading dot.
pub fn file_name(key: &str) -> String {
    let name = key.chars().map(|c| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '_' });
    name.enumerate().map(|(i, c)| if i == 0 && c == '.' { '_' } else { c }).collect()
}

/// RGB in [0, 1], `[height, width, 3]`, from a PNG of 8 or 16 bits without transparency.
fn read_picture(path: &Path, height: usize, width: usize) -> Result<Vec<f32>, EvalError> {
    let bad = |reason: String| EvalError::BadPrediction { reason, path: path.into() };
    let mut reader = ImageReader::open(path).map_err(|error| bad(error.to_string()))?;
    // A size that a header only claims is refused before there is memory for it.
    let mut limits = Limits::default();
    (limits.max_image_width, limits.max_image_height) = (Some(1 << 14), Some(1 << 14));
    reader.limits(limits);
    let picture = reader.decode().map_err(|error| bad(error.to_string()))?;
    let found = (picture.height() as usize, picture.width() as usize);
    if found != (height, width) {
        let reason = format!("it has {} x {} pixels, the target {width} x {height}", found.1, found.0);
        return Err(bad(reason));
    }
    let has_alpha = picture.color().has_alpha();
    if has_alpha && picture.to_rgba8().pixels().any(|pixel| pixel.0[3] != u8::MAX) {
        return Err(bad("it is partly transparent: over which colour is not known".into()));
    }
    // 255 levels as data has them: exactly v / 255.
    Ok(match picture {
        DynamicImage::ImageRgb16(_) | DynamicImage::ImageRgba16(_) => picture.into_rgb32f().into_raw(),
        _ => picture.into_rgb8().into_raw().into_iter().map(|value| f32::from(value) / 255.0).collect(),
    })
}

#[cfg(test)]
mod tests {
    use clift_data::{ClipViews, Intrinsics, Pose};

    use super::*;
    use crate::figures::canvas::Canvas;

    fn clip() -> Clip {
        let intrinsics = Intrinsics { fx: 16.0, fy: 16.0, cx: 8.0, cy: 8.0 };
        let views = |frame_index: Vec<usize>| ClipViews {
            width: 24,
            height: 16,
            images: vec![100; frame_index.len() * 24 * 16 * 3],
            c2w: vec![Pose::IDENTITY; frame_index.len()],
            intrinsics: vec![intrinsics; frame_index.len()],
            frame_index,
        };
        Clip { key: "a/room".into(), context: views(vec![0]), target: views(vec![3, 12, 40]) }
    }

    fn system(folder: &Path) -> ExternalMethod {
        ExternalMethod { name: MethodName::new("MVSplat").unwrap(), folder: folder.into(), data_bytes: Some(5000) }
    }

    fn write(folder: &Path, name: &str, level: u8, (width, height): (usize, usize)) {
        let path = folder.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        Canvas::new(width, height, [level; 3]).write_png(&path).unwrap();
    }

    #[test]
    fn pictures_are_found_in_both_layouts_and_missing_ones_are_named() {
        let folder = tempfile::tempdir().unwrap();
        write(folder.path(), "a_room/000003.png", 100, (24, 16));
        write(folder.path(), "a_room/color/000040.png", 151, (24, 16));
        let (clip, mut into) = (clip(), EvalResults::default());
        let scorer = ViewScorer::new(&clip.target, None);
        let scored = system(folder.path()).score(&clip, &scorer, &[2], &mut into).unwrap();
        assert_eq!(scored.measured.keys().copied().collect::<Vec<_>>(), [0, 2]);
        assert_eq!(scored.measured[&0].psnr, f64::INFINITY);
        // 51 of 255 levels: a fifth.
        assert!((scored.measured[&2].psnr - -20.0 * 0.2_f64.log10()).abs() < 1e-5);
        assert_eq!(scored.shown.keys().copied().collect::<Vec<_>>(), [2]);
        let missing = &into.missing[&MethodName::new("MVSplat").unwrap()];
        assert_eq!(missing.iter().collect::<Vec<_>>(), ["a_room/000012.png"]);
    }

    #[test]
    fn a_picture_of_another_size_or_that_is_none_is_an_error_with_its_path() {
        let folder = tempfile::tempdir().unwrap();
        let (clip, mut into) = (clip(), EvalResults::default());
        let scorer = ViewScorer::new(&clip.target, None);
        write(folder.path(), "a_room/000003.png", 1, (16, 24));
        let message = |into: &mut EvalResults| {
            let Err(error) = system(folder.path()).score(&clip, &scorer, &[], into) else { panic!("accepted") };
            error.to_string()
        };
        let text = message(&mut into);
        assert!(text.contains("it has 16 x 24 pixels, the target 24 x 16") && text.ends_with("000003.png"), "{text}");
        std::fs::write(folder.path().join("a_room/000003.png"), "no picture").unwrap();
        assert!(message(&mut into).ends_with("000003.png"));
    }

    #[test]
    fn no_key_leaves_the_folder() {
        assert_eq!(["..", "../x", "/etc", "a b"].map(file_name), ["_.", "_._x", "_etc", "a_b"]);
    }
}
