//! `clift data info`.

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use clift_data::{
    ClipReader, DataError, DatasetRoot, EvaluationIndex, IndexStatistics, OpenedSource, SceneSource, SceneSubset,
    SkipReport, SourceInfo, SourceKind, Split, open_dataset, open_source,
};
use clift_eval::{EvalFrames, evaluation_items};
use clift_train::Config;

use crate::commands::args::shared_args::{JsonArg, read_config};
use crate::commands::args::splits::{Splits, present_splits, read_all_options};
use crate::commands::data::info_report::{EvaluationReport, Report, SplitReport};
use crate::exit_code::usage_bail;
use crate::output::counter::ScanCounter;
use crate::output::stdout::print_result;

/// Most synthetic scenes that are described: a config may have millions of similar ones.
const MAX_SYNTHETIC: usize = 1000;

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
    let report = if args.path.is_dir() || is_scene {
        if !args.set.is_empty() {
            usage_bail!("--set needs a config, {} is a data set", args.path.display());
        }
        describe_folder(&args.path)?
    } else {
        let (config, _) = read_config(&args.path, &args.set, Config::validate)?;
        describe_config(&args.path, &config)?
    };
    print_result(&report.to_string())?;
    json.write(&report)?;
    let failed = report.splits.values().filter_map(|split| split.error.as_ref());
    let failed = failed.chain(report.evaluation.as_ref().and_then(|evaluation| evaluation.error.as_ref()));
    anyhow::ensure!(failed.count() == 0, "a part of the data is not usable; the table above lists the reason");
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

fn describe_config(path: &Path, config: &Config) -> anyhow::Result<Report> {
    let data = &config.data;
    let mut report = Report { path: path.to_owned(), ..Report::default() };
    for split in [Split::Train, Split::Test] {
        let mut counter = ScanCounter::default();
        let opened = open_dataset(data, split, &mut |done, total| counter.set(done, total));
        let described = opened.and_then(|opened| {
            if split == Split::Test {
                let frames = EvalFrames::new(&opened, split, data.hold_out, true);
                report.evaluation = Some(evaluation(config, opened.source.clone(), frames));
            }
            let first = |source| -> Arc<dyn SceneSource> {
                match data.source {
                    SourceKind::Synthetic => Arc::new(SceneSubset::first(source, MAX_SYNTHETIC)),
                    _ => source,
                }
            };
            let training = first(opened.training_source(data.hold_out));
            let OpenedSource { source, report: skips, .. } = opened;
            let mut described = describe_split(first(source).as_ref(), &skips)?;
            if split == Split::Train {
                described.views = Some(long_enough(config, training.as_ref()));
            }
            Ok(described)
        });
        report.splits.insert(split.to_string(), or_error(described));
    }
    let tokens = |num_views| config.model.num_tokens(num_views, data.height, data.width);
    report.num_tokens = Some([tokens(data.views.min_context)?, tokens(data.views.max_context)?]);
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
        num_described: source.num_scenes(),
        keys: (0..source.num_scenes()).map(|scene| source.key(scene).to_owned()).collect(),
        info: Some(SourceInfo::read(source)?),
        views: None,
    })
}

fn counts(skips: &SkipReport) -> BTreeMap<String, usize> {
    skips.counts().into_iter().map(|(reason, count)| (reason.to_owned(), count)).collect()
}

fn or_error<E: fmt::Display>(described: Result<SplitReport, E>) -> SplitReport {
    described.unwrap_or_else(|error| SplitReport { error: Some(error.to_string()), ..Default::default() })
}

/// Returns the frames that `data.views` needs at the last step, and the number of scenes with as many training frames.
fn long_enough(config: &Config, source: &dyn SceneSource) -> [usize; 2] {
    let needed = config.data.views.min_frames(config.stage1.steps);
    let mut num_long = 0;
    for scene in 0..source.num_scenes() {
        // Unreadable scenes are part of the description.
        num_long += usize::from(source.num_frames(scene).is_ok_and(|count| count >= needed));
    }
    [needed, num_long]
}

fn evaluation(config: &Config, source: Arc<dyn SceneSource>, frames: EvalFrames) -> EvaluationReport {
    let reader = ClipReader { source, options: config.data.clip_options() };
    match evaluation_items(&config.eval, &reader, frames) {
        Ok((items, skips, split)) => EvaluationReport {
            error: None,
            split: Some(split),
            num_scenes: items.len(),
            num_views: items.iter().map(|item| item.views.target.len()).sum(),
            skipped: counts(&skips),
        },
        Err(error) => EvaluationReport { error: Some(error.to_string()), ..Default::default() },
    }
}

#[derive(Debug, clap::Args)]
pub struct InfoArgs {
    /// Data set, one scene, config (TOML) or evaluation index (JSON)
    #[arg(value_name = "DIR|CONFIG|INDEX")]
    pub path: PathBuf,
    /// Override a key of the config, e.g. `data.filters.min_frames=60`; repeatable
    #[arg(long, value_name = "KEY=TOML")]
    pub set: Vec<String>,
    #[command(flatten)]
    pub json: JsonArg,
}

#[cfg(test)]
mod tests {
    use clift_core::RgbImage;
    use clift_data::encode_png;

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

    #[test]
    fn config_is_described_with_its_remaining_scenes() {
        let mut config = Config::default();
        (config.data.source, config.data.root) = (SourceKind::Chunks, Some(fixtures()));
        (config.data.width, config.data.height) = (48, 32);
        config.data.filters.min_frames = 8;
        config.eval.index = Some(fixtures().join("evaluation_index.json"));
        let text = describe_config(Path::new("a.toml"), &config).unwrap().to_string();
        assert!(text.contains("  long enough     0 of 2: data.views.min_gap needs 46 training frames"), "{text}");
        assert!(
            text.contains("evaluation        4 views of 1 scene, test split\n  skipped         2 without views"),
            "{text}"
        );
        assert!(text.ends_with("tokens per scene  96 to 144"), "{text}");

        config.data.filters.min_frames = 9;
        let report = describe_config(Path::new("a.toml"), &config).unwrap();
        let error = report.splits["train"].error.as_deref().unwrap();
        assert!(
            error.contains("0 of 2 scenes used; 2 shorter than the 9 frames of data.filters.min_frames"),
            "{error}"
        );
        assert!(report.evaluation.is_none());
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
    fn held_out_frames_do_not_make_a_capture_long_enough() {
        let root = tempfile::tempdir().unwrap();
        write_capture(&root.path().join("attic"), 32, 7);
        let mut config = Config::default();
        (config.data.source, config.data.root) = (SourceKind::Captures, Some(root.path().to_owned()));
        (config.data.width, config.data.height) = (32, 24);
        (config.data.views.min_gap, config.data.views.max_gap) = ([5, 6], [8, 24]);
        for (hold_out, expected) in [(8, "0 of 1"), (0, "1 of 1")] {
            config.data.hold_out = hold_out;
            let text = describe_config(Path::new("a.toml"), &config).unwrap().to_string();
            let expected = format!("  long enough     {expected}: data.views.min_gap needs 7 training frames");
            assert!(text.contains(&expected), "{text}");
        }
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
        let mut split = SplitReport { num_scenes: 1, num_used: 1, num_described: 1, ..SplitReport::default() };
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
