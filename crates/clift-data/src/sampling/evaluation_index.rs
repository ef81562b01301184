//! Evaluation indices: context and target frames of the evaluated scenes.

use std::collections::HashSet;
use std::fmt;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde::de::{Deserializer, MapAccess, Visitor};

use crate::error::DataError;
use crate::files::bounded::{parse_json, read_bounded};
use crate::sampling::clip::ViewIndices;
use crate::scene_source::SceneSource;
use crate::skip_report::SkipReport;

const MAX_BYTES: u64 = 1 << 30;

/// An evaluation index in the published form `{key: {"context": [..], "target": [..]} | null | {}}`, in file order.
#[derive(Clone, Debug)]
pub struct EvaluationIndex {
    path: PathBuf,
    /// Every key with its views, `None` for null and empty entries.
    entries: Vec<(String, Option<ViewIndices>)>,
}

/// One scene to evaluate.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EvaluationItem {
    /// Position of the scene in the source.
    pub scene: usize,
    /// Context and target frames, all within the scene.
    pub views: ViewIndices,
}

impl EvaluationIndex {
    /// Reads an index file.
    ///
    /// # Errors
    /// [`DataError::Io`], and [`DataError::BadIndex`] for another form, a repeated key, and an entry with only contexts
    /// or only targets.
    pub fn read(path: &Path) -> Result<Self, DataError> {
        let text = read_bounded(path, MAX_BYTES, "reading the evaluation index")?;
        let bad = |what: String| DataError::BadIndex { what, path: path.to_path_buf() };
        let file: IndexFile = parse_json(&text).map_err(|error| {
            bad(format!("expected {{key: {{\"context\": [..], \"target\": [..]}} or null}}, got {error}"))
        })?;
        let mut keys = HashSet::with_capacity(file.0.len());
        let mut entries = Vec::with_capacity(file.0.len());
        for (key, entry) in file.0 {
            let views = entry.filter(|entry| *entry != ViewIndices::default());
            if let Some(ViewIndices { context, target }) = &views
                && (context.is_empty() || target.is_empty())
            {
                let (contexts, targets) = (context.len(), target.len());
                return Err(bad(format!("scene {key} has {contexts} context and {targets} target frames")));
            }
            if !keys.insert(key.clone()) {
                return Err(bad(format!("scene {key} is listed twice")));
            }
            entries.push((key, views));
        }
        Ok(Self { path: path.to_path_buf(), entries })
    }

    /// Removes the targets that are also contexts. Scenes without another target are skipped by [`select`](Self::select).
    #[must_use]
    pub fn without_context_targets(mut self) -> Self {
        for views in self.entries.iter_mut().filter_map(|(_, views)| views.as_mut()) {
            let ViewIndices { context, target } = views;
            target.retain(|frame| !context.contains(frame));
        }
        self
    }

    /// Selects the first `limit` evaluable scenes of `source` (0: all), in file order.
    ///
    /// The report lists the skipped entries: null or empty ones, entries without targets, keys that the source does not have, scenes with
    /// unreadable cameras, and scenes with too few frames. `num_scenes` of the report counts the examined entries.
    pub fn select(&self, source: &dyn SceneSource, limit: usize) -> (Vec<EvaluationItem>, SkipReport) {
        let mut report = SkipReport::default();
        let mut items = Vec::new();
        for (key, views) in &self.entries {
            if limit > 0 && items.len() == limit {
                break;
            }
            report.num_scenes += 1;
            let Some(views) = views else {
                report.skip(key, "without views in the evaluation index");
                continue;
            };
            if views.target.is_empty() {
                report.skip(key, "with contexts as its only targets");
                continue;
            }
            let Some(scene) = source.find(key) else {
                report.skip(key, "not in the data");
                continue;
            };
            match source.cameras(scene).and_then(|cameras| self.check_frames(key, views, cameras.len())) {
                Ok(()) => items.push(EvaluationItem { scene, views: views.clone() }),
                Err(error) => report.skip(key, error.to_string()),
            }
        }
        (items, report)
    }

    fn check_frames(&self, key: &str, views: &ViewIndices, num_frames: usize) -> Result<(), DataError> {
        match views.context.iter().chain(&views.target).find(|frame| **frame >= num_frames) {
            Some(frame) => Err(DataError::BadIndex {
                what: format!("frame {frame} of scene {key} does not exist, the scene has {num_frames} frames"),
                path: self.path.clone(),
            }),
            None => Ok(()),
        }
    }
}

/// A JSON map in file order.
struct IndexFile(Vec<(String, Option<ViewIndices>)>);

impl<'de> Deserialize<'de> for IndexFile {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct InOrder;
        impl<'de> Visitor<'de> for InOrder {
            type Value = IndexFile;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a map from scene keys")
            }
            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<IndexFile, A::Error> {
                let mut entries = Vec::new();
                while let Some(entry) = map.next_entry()? {
                    entries.push(entry);
                }
                Ok(IndexFile(entries))
            }
        }
        deserializer.deserialize_map(InOrder)
    }
}

/// Spreads contexts evenly from the first to the last of `num_frames` frames, and targets over the other frames.
///
/// Returns `None` for fewer frames than views, and for fewer than 2 contexts.
pub fn even_views(num_frames: usize, num_context: usize, num_targets: usize) -> Option<ViewIndices> {
    even_views_of(&(0..num_frames).collect::<Vec<_>>(), None, num_context, num_targets)
}

/// Spreads contexts evenly over `frames`, and targets over `targets`, or over the other `frames` without `targets`. Frames
/// ascend; `targets` holds none of `frames` and may have fewer than `num_targets`.
///
/// Returns `None` for fewer frames than views, and for fewer than 2 contexts.
pub fn even_views_of(
    frames: &[usize],
    targets: Option<&[usize]>,
    num_context: usize,
    num_targets: usize,
) -> Option<ViewIndices> {
    let num_targets = targets.map_or(num_targets, |targets| num_targets.min(targets.len()));
    let needed = if targets.is_some() { num_context } else { num_context.checked_add(num_targets)? };
    if num_context < 2 || num_targets == 0 || frames.len() < needed {
        return None;
    }
    let spread = |view: usize, count: usize, of: usize| (view * (of - 1) + (count - 1) / 2) / (count - 1);
    let context: Vec<usize> = (0..num_context).map(|view| frames[spread(view, num_context, frames.len())]).collect();
    let rest = targets.unwrap_or(frames).iter().copied().filter(|frame| !context.contains(frame));
    let rest: Vec<usize> = rest.collect();
    // With two frames to spare, the outermost ones, next to a context, are not targets.
    let has_spare = rest.len() >= num_targets + 2;
    let position = |target: usize| if has_spare { spread(target + 1, num_targets + 2, rest.len()) } else { target };
    let target = (0..num_targets).map(|target| rest[position(target)]).collect();
    Some(ViewIndices { context, target })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{read_from_file, rooms_with_a_broken_one};

    fn index(json: &str) -> Result<EvaluationIndex, DataError> {
        read_from_file("index.json", json, EvaluationIndex::read)
    }

    #[test]
    fn even_views_span_the_scene_and_targets_are_no_contexts() {
        for num_frames in 7..200 {
            let ViewIndices { context, target } = even_views(num_frames, 4, 3).unwrap();
            assert_eq!((context[0], context[3]), (0, num_frames - 1));
            assert_eq!((context.len(), target.len()), (4, 3));
            assert!(context.is_sorted_by(|a, b| a < b) && target.is_sorted_by(|a, b| a < b), "{context:?} {target:?}");
            assert!(target.iter().all(|frame| !context.contains(frame) && *frame < num_frames));
        }
        assert_eq!(even_views(16, 4, 3).unwrap().context, [0, 5, 10, 15]);
        assert!([even_views(6, 4, 3), even_views(9, 1, 3), even_views(0, 0, 0)].iter().all(Option::is_none));
        // Of 21 frames every 8th is a target only.
        let frames: Vec<usize> = (0..21).filter(|frame| frame % 8 != 0).collect();
        let views = even_views_of(&frames, Some(&[0, 8, 16]), 4, 5).unwrap();
        assert_eq!((views.context, views.target), (vec![1, 7, 13, 20], vec![0, 8, 16]));
        assert_eq!(even_views_of(&frames, Some(&[]), 4, 3), None);
        assert!([even_views(9, 2, usize::MAX), even_views(9, usize::MAX, 2)].iter().all(Option::is_none));
    }

    #[test]
    fn invalid_forms_are_refused_with_the_reason() {
        let message = |json: &str| index(json).unwrap_err().to_string();
        assert!(message("[]").contains("expected {key:"), "{}", message("[]"));
        assert!(message(r#"{"a": {"context": [-1], "target": [1]}}"#).contains("-1"));
        assert!(message(r#"{"a": {"context": [1]}}"#).contains("scene a has 1 context and 0 target frames"));
        assert!(message(r#"{"a": null, "a": null}"#).contains("scene a is listed twice"));
    }

    #[test]
    fn unusable_entries_are_skipped_up_to_the_limit() {
        let source = rooms_with_a_broken_one(5);
        let last_frames = [8, 7, 7, 7, 7]; // the first scene has no frame 8
        let entries: Vec<String> = (0..5)
            .map(|scene| {
                format!(r#""{}": {{"context": [0, {}], "target": [3, 0]}}"#, source.key(scene), last_frames[scene])
            })
            .collect();
        let others = r#""none": null, "empty": {}, "a": {"context": [0, 2], "target": [3]}, "b": {"context": [0, 2], "target": [2]}"#;
        let index = index(&format!("{{{}, {others}}}", entries.join(","))).unwrap().without_context_targets();
        let scenes = |items: &[EvaluationItem]| items.iter().map(|item| item.scene).collect::<Vec<_>>();
        let (items, report) = index.select(&source, 0);
        assert_eq!((scenes(&items), report.num_scenes), (vec![2, 3, 4], 9));
        assert_eq!((&items[0].views.target[..], report.counts()["with contexts as its only targets"]), (&[3][..], 1));
        assert_eq!(report.counts()["without views in the evaluation index"], 2);
        assert_eq!(report.counts()["not in the data"], 1);
        assert!(report.skips[0].reason.contains("frame 8 of scene"), "{report}");
        assert_eq!(report.skips[1].reason, "bad camera: the pose holds NaN");
        let (items, report) = index.select(&source, 2);
        assert_eq!((scenes(&items), report.num_scenes, report.num_used()), (vec![2, 3], 4, 2));
    }
}
