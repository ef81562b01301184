//! `clift data info`.

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

use clift_data::{
    DataError, DatasetRoot, EvaluationIndex, IndexStatistics, SceneSource, SkipReport, SourceInfo, open_source,
};

use crate::commands::args::shared_args::JsonArg;
use crate::commands::args::splits::{Splits, present_splits, read_all_options};
use crate::commands::data::info_report::{Report, SplitReport};
use crate::output::stdout::print_result;

pub fn run(args: &InfoArgs) -> anyhow::Result<()> {
    let json = args.json.open(&[&args.path])?;
    let is_json = args.path.extension().is_some_and(|extension| extension == "json");
    // A scene may be given by one of its camera files, e.g. transforms_train.json.
    let name = args.path.file_name().unwrap_or_default().to_string_lossy();
    let is_scene = is_json && name.starts_with("transforms");
    if is_json && !is_scene {
        let statistics = IndexStatistics::new(&EvaluationIndex::read(&args.path)?);
        print_result(&format!("{statistics}\n"))?;
        return json.write(&statistics);
    }
    let report = describe_folder(&args.path)?;
    print_result(&report.to_string())?;
    json.write(&report)?;
    let is_usable = report.splits.values().all(|split| split.error.is_none());
    anyhow::ensure!(is_usable, "a part of the data is not usable; the table above lists the reason");
    Ok(())
}

fn describe_folder(root: &Path) -> anyhow::Result<Report> {
    let mut report = Report { path: root.to_owned(), ..Report::default() };
    let root = DatasetRoot::find(root)?;
    for split in present_splits(&root, Splits::Both) {
        let name = if root.has_splits { split.to_string() } else { "all".into() };
        let described = match open_source(&root, split, &read_all_options()) {
            Ok(opened) => {
                report.layout = Some(opened.kind);
                describe_split(opened.source.as_ref(), &opened.report)
            }
            Err(error @ DataError::UnknownLayout { .. }) => return Err(error.into()),
            Err(error) => Err(error),
        };
        report.splits.insert(name, or_error(described));
    }
    Ok(report)
}

fn describe_split(source: &dyn SceneSource, skips: &SkipReport) -> Result<SplitReport, clift_data::DataError> {
    Ok(SplitReport {
        error: None,
        num_scenes: skips.num_scenes,
        num_used: skips.num_used(),
        skipped: counts(skips),
        left_out: skips.skips.clone(),
        frames: skips.frames.clone(),
        notes: skips.notes.clone(),
        keys: (0..source.num_scenes()).map(|scene| source.key(scene).to_owned()).collect(),
        info: Some(SourceInfo::read(source)?),
    })
}

fn counts(skips: &SkipReport) -> BTreeMap<String, usize> {
    skips.counts().into_iter().map(|(reason, count)| (reason.to_owned(), count)).collect()
}

fn or_error<E: fmt::Display>(described: Result<SplitReport, E>) -> SplitReport {
    described.unwrap_or_else(|error| SplitReport { error: Some(error.to_string()), ..Default::default() })
}

#[derive(Debug, clap::Args)]
pub struct InfoArgs {
    /// Data set, one scene, or evaluation index (JSON)
    #[arg(value_name = "DIR|INDEX")]
    pub path: PathBuf,
    #[command(flatten)]
    pub json: JsonArg,
}

#[cfg(test)]
mod tests {
    use clift_core::RgbImage;
    use clift_data::{SourceKind, encode_png};

    use super::*;

    fn fixtures() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../data-fixtures/re10k-mini")
    }

    #[test]
    fn folder_is_described_split_by_split() {
        let text = describe_folder(&fixtures()).unwrap().to_string();
        let expected = "layout            chunks
train             2 scenes
  keys            00000000000000a1, 00000000000000a2
  frames          8 / 8 / 8 (smallest / median / largest)
  image           64x36
  field of view   58.1 / 58.1 / 58.1 deg
  path extent     0.350 / 0.350 / 0.350
test              1 scene
";
        assert!(text.starts_with(expected), "{text}");
    }

    fn write_capture(folder: &Path, width: usize, num_photos: usize) {
        std::fs::create_dir(folder).unwrap();
        let image = RgbImage { width, height: 24, rgb: vec![9; width * 24 * 3] };
        let mut frames = Vec::new();
        for photo in 0..num_photos {
            std::fs::write(folder.join(format!("{photo}.png")), encode_png(&image).unwrap()).unwrap();
            let pose = "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]";
            frames.push(format!(r#"{{"file_path": "{photo}.png", "transform_matrix": {pose}}}"#));
        }
        let cameras = format!(r#"{{"fl_x": 20, "frames": [{}]}}"#, frames.join(","));
        std::fs::write(folder.join("transforms.json"), cameras).unwrap();
    }

    #[test]
    fn captures_are_listed_with_keys_and_every_size() {
        let root = tempfile::tempdir().unwrap();
        for (key, width) in [("attic", 32), ("barn", 48), ("cellar", 48)] {
            write_capture(&root.path().join(key), width, 1);
        }
        let text = describe_folder(root.path()).unwrap().to_string();
        assert!(text.contains("\n  keys            attic, barn, cellar\n"), "{text}");
        assert!(text.contains("\n  image           48x24 (2 scenes), 32x24 (1 scene)\n"), "{text}");
    }

    #[test]
    fn skipped_scenes_are_listed_with_reasons() {
        let root = tempfile::tempdir().unwrap();
        let train = root.path().join("train");
        std::fs::create_dir(&train).unwrap();
        std::fs::copy(fixtures().join("train/000000.torch"), train.join("000000.torch")).unwrap();
        std::fs::write(train.join("000001.torch"), "cut").unwrap();
        let index = r#"{"00000000000000a1": "000000.torch", "elsewhere": "000000.torch", "cut": "000001.torch"}"#;
        std::fs::write(train.join("index.json"), index).unwrap();
        let report = describe_folder(root.path()).unwrap();
        let split = &report.splits["train"];
        assert!(split.error.is_none() && split.info.is_some());
        let keys: Vec<&str> = split.left_out.iter().map(|skip| skip.key.as_str()).collect();
        assert!(keys.contains(&"cut") && keys.contains(&"elsewhere"), "{keys:?}");
        let text = report.to_string();
        assert!(text.contains("train             1 of "), "{text}");
        for expected in ["  skipped         cut: bad chunk: ", "  skipped         elsewhere: bad chunk: "] {
            assert!(text.contains(expected), "{text}");
        }
    }

    #[test]
    fn unusable_capture_has_no_split() {
        let root = tempfile::tempdir().unwrap();
        std::fs::write(root.path().join("transforms.json"), r#"{"fl_x": 20, "frames": []}"#).unwrap();
        let text = describe_folder(root.path()).unwrap().to_string();
        assert!(text.starts_with("all               bad scene: no frames listed: "), "{text}");
    }

    #[test]
    fn skipped_frames_are_listed_by_scene() {
        let mut split = SplitReport { num_scenes: 1, num_used: 1, ..SplitReport::default() };
        let mut skips = SkipReport::new(1);
        for name in ["0005.jpg", "0016.jpg"] {
            skips.skip_frame("fox", name, "without an image");
        }
        (split.frames, split.notes) = (skips.frames, vec!["both halves are the same scenes".into()]);
        let splits = BTreeMap::from([("all".into(), split)]);
        let text = Report { layout: Some(SourceKind::Captures), splits, ..Report::default() }.to_string();
        let expected = "layout            captures
all               1 scene
  skipped         of fox 2 frames without an image: 0005.jpg, 0016.jpg
  note            both halves are the same scenes";
        assert_eq!(text, expected);
    }
}
