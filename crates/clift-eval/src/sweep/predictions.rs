//! Images of the target views by an external method, scored like the images of the own methods.
//!
//! An image lies at `FOLDER/<scene>/<target frame>.png` with six digits, or at `FOLDER/<scene>/color/<target frame>.png`,
//! the layout of pixelSplat.

use std::path::{Path, PathBuf};

use clift_core::derive_seed;
use clift_data::Clip;
use image::{DynamicImage, ImageReader, Limits};

use crate::config::method::{Method, MethodName};
use crate::error::EvalError;
use crate::statistics::eval_results::EvalResults;
use crate::statistics::view_metrics::EvalKey;
use crate::sweep::rendered_views::ScoredViews;
use crate::sweep::view_scorer::ViewScorer;

/// A method of another program, given by its images of the target views.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ExternalMethod {
    /// Name in tables and plots.
    pub name: MethodName,
    /// Folder of the images.
    pub folder: PathBuf,
    /// Bytes that the method stores per scene, compared with the size of scene files.
    pub data_bytes: Option<u64>,
}

impl ExternalMethod {
    /// Returns the key of the method's views.
    pub const fn key(&self) -> EvalKey {
        EvalKey::baseline(Method::External(self.name))
    }

    /// Scores the images of a scene's target views, and records missing images in `results`.
    pub(crate) fn score(
        &self,
        clip: &Clip,
        scorer: &ViewScorer,
        kept_views: &[usize],
        results: &mut EvalResults,
    ) -> Result<ScoredViews, EvalError> {
        let mut scored = ScoredViews::new(self.key());
        for (view, &frame) in clip.target.frame_index.iter().enumerate() {
            if let Some(path) = self.find(&clip.key, frame) {
                let pixels = read_image(&path, clip.target.height, clip.target.width)?;
                scored.add(view, pixels, scorer, kept_views)?;
            } else {
                results.record_missing_image(scored.key.method, image_name(&clip.key, frame));
            }
        }
        if let Some(bytes) = self.data_bytes {
            results.add_scene_bytes(scored.key, bytes);
        }
        Ok(scored)
    }

    fn find(&self, key: &str, frame: usize) -> Option<PathBuf> {
        let scene = self.folder.join(file_name(key));
        let name = format!("{frame:06}.png");
        [scene.join(&name), scene.join("color").join(&name)].into_iter().find(|path| path.is_file())
    }
}

/// Returns the path of a target image inside the folder of an external method.
pub fn image_name(key: &str, frame: usize) -> String {
    format!("{}/{frame:06}.png", file_name(key))
}

/// Largest number of characters of a scene key in a file name. File systems allow 255 bytes, with the ending.
const MAX_KEY_CHARS: usize = 120;

/// Returns a scene key as a file name: every character except letters, digits, `-`, `_` and `.` becomes `_`, and a
/// leading dot does too. Of a longer key the name has the first 120 characters, `-` and a hash of the key as 16 hexadecimal
/// digits.
pub fn file_name(key: &str) -> String {
    let name = key.chars().map(|c| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '_' });
    let name: String = name.enumerate().map(|(i, c)| if i == 0 && c == '.' { '_' } else { c }).collect();
    if name.len() <= MAX_KEY_CHARS { name } else { format!("{}-{:016x}", &name[..MAX_KEY_CHARS], derive_seed(0, key)) }
}

/// Returns a scene key as a file name of its own: [`file_name`], with a hash of the key if that is another text, so that the
/// files of `a/b` and `a_b` differ.
pub fn distinct_file_name(key: &str) -> String {
    let name = file_name(key);
    let has_hash = name.len() > MAX_KEY_CHARS;
    if name == key || has_hash { name } else { format!("{name}-{:08x}", derive_seed(0, key) as u32) }
}

/// Reads an opaque PNG of 8 or 16 bits as `[height, width, 3]` in `[0, 1]`.
fn read_image(path: &Path, height: usize, width: usize) -> Result<Vec<f32>, EvalError> {
    let bad = |reason: String| EvalError::BadPrediction { reason, path: path.into() };
    let mut reader = ImageReader::open(path).map_err(|error| bad(error.to_string()))?;
    // Refuses a huge size in the header before the decoder allocates it.
    let mut limits = Limits::default();
    (limits.max_image_width, limits.max_image_height) = (Some(1 << 14), Some(1 << 14));
    reader.limits(limits);
    let image = reader.decode().map_err(|error| bad(error.to_string()))?;
    let found = (image.height() as usize, image.width() as usize);
    if found != (height, width) {
        return Err(bad(format!("{} x {} pixels, expected {width} x {height} like the target", found.1, found.0)));
    }
    let has_alpha = image.color().has_alpha();
    if has_alpha && image.to_rgba8().pixels().any(|pixel| pixel.0[3] != u8::MAX) {
        return Err(bad("partly transparent: the background colour is unknown; write opaque images".into()));
    }
    // Exactly v / 255, like the target.
    Ok(match image {
        DynamicImage::ImageRgb16(_) | DynamicImage::ImageRgba16(_) => image.into_rgb32f().into_raw(),
        _ => image.into_rgb8().into_raw().into_iter().map(|value| f32::from(value) / 255.0).collect(),
    })
}

#[cfg(test)]
mod tests {
    use clift_core::Pose;

    use super::*;
    use crate::figures::canvas::Canvas;
    use crate::testing::gray_views;

    fn clip() -> Clip {
        let views = |frames: &[usize]| gray_views((24, 16), 100, vec![Pose::IDENTITY; frames.len()], frames.to_vec());
        Clip { key: "a/room".into(), context: views(&[0]), target: views(&[3, 12, 40]), target_weights: None }
    }

    fn external(folder: &Path) -> ExternalMethod {
        ExternalMethod { name: MethodName::new("MVSplat").unwrap(), folder: folder.into(), data_bytes: Some(5000) }
    }

    fn write(folder: &Path, name: &str, level: u8, (width, height): (usize, usize)) {
        let path = folder.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        Canvas::new(width, height, [level; 3]).write_png(&path).unwrap();
    }

    #[test]
    fn both_layouts_are_found_and_missing_images_recorded() {
        let folder = tempfile::tempdir().unwrap();
        write(folder.path(), "a_room/000003.png", 100, (24, 16));
        write(folder.path(), "a_room/color/000040.png", 151, (24, 16));
        let (clip, mut into) = (clip(), EvalResults::default());
        let scorer = ViewScorer::new(&clip, None);
        let scored = external(folder.path()).score(&clip, &scorer, &[2], &mut into).unwrap();
        assert_eq!(scored.metrics.keys().copied().collect::<Vec<_>>(), [0, 2]);
        assert_eq!(scored.metrics[&0].psnr, f64::INFINITY);
        // 51 of 255 levels: a fifth.
        assert!((scored.metrics[&2].psnr - -20.0 * 0.2_f64.log10()).abs() < 1e-5);
        assert_eq!(scored.images.keys().copied().collect::<Vec<_>>(), [2]);
        let missing = &into.missing[&"MVSplat".parse().unwrap()];
        assert_eq!(missing.iter().collect::<Vec<_>>(), ["a_room/000012.png"]);
        std::fs::write(folder.path().join("a_room/000012.png"), "no image").unwrap();
        let error = external(folder.path()).score(&clip, &scorer, &[], &mut into).err().unwrap().to_string();
        assert!(error.ends_with("a_room/000012.png"), "{error}");
    }

    #[test]
    fn file_names_stay_in_the_folder() {
        assert_eq!(["..", "../x", "/etc", "a b"].map(file_name), ["_.", "_._x", "_etc", "a_b"]);
    }

    #[test]
    fn long_keys_have_short_distinct_names() {
        let [a, b] = ["a", "b"].map(|end| file_name(&format!("{}{end}", "room".repeat(1250))));
        assert!(a.len() < 200 && b.len() == a.len() && a != b, "{a} {b}");
        assert_eq!(file_name(&"x".repeat(120)), "x".repeat(120));
        let names = ["a/b", "a_b", "a?b"].map(distinct_file_name);
        assert!(names[1] == "a_b" && names.iter().collect::<std::collections::BTreeSet<_>>().len() == 3, "{names:?}");
    }
}
