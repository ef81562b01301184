//! Measuring a run on views it never trained on: during training and at its end.

use std::ffi::OsStr;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use burn::tensor::Device;
use clift_data::files::replace;
use clift_data::order::derive_seed;
use clift_data::unfinished::Unfinished;
use clift_data::{ClipReader, EvaluationItem, Ledger};
use clift_eval::lpips::{LPIPS_COMMAND, LPIPS_MIN_SIZE_PX};
use clift_eval::picture::Picture;
use clift_eval::predictions::{file_name, picture_name};
use clift_eval::report::MAX_EXHIBITS;
use clift_eval::summary::scenes::write_scenes;
use clift_eval::{
    Condensed, EvalConfig, EvalError, EvalResults, Exhibit, Lpips, Networks, Report, Shown, Summary, Sweep, System,
    TokenCount, Variant, evaluate_scene,
};
use clift_model::device::DeviceName;
use clift_model::{Clift, Grouping};

use crate::TrainError;
use crate::config::Config;
use crate::events::{Event, Sink, Stage};
use crate::footprint::largest_tensor;
use crate::scenes::evaluation_items;

/// The held-out views of a run.
pub struct HeldOut<'a> {
    config: &'a Config,
    reader: ClipReader,
    items: Vec<EvaluationItem>,
    ledger: Ledger,
    device: Device,
}

impl<'a> HeldOut<'a> {
    /// Chooses the scenes of `reader` and their views that `eval` names, to be measured on `device`.
    ///
    /// # Errors
    /// As [`evaluation_items`], [`TrainError::BadConfig`] for a count a scene does not have, and what the device cannot
    /// hold or compute.
    pub fn new(config: &'a Config, eval: &EvalConfig, reader: ClipReader, device: &Device) -> Result<Self, TrainError> {
        eval.precision.check("eval.precision", device)?;
        largest_tensor::check(config, device, &[Stage::Eval])?;
        let (items, ledger) = evaluation_items(eval, &reader, eval.num_scenes)?;
        // A count that a scene does not have is found now, not at the end of training.
        let tokens_per_view = config.model.num_tokens(1, config.data.height, config.data.width)?;
        let fewest_views = items.iter().map(|item| item.views.context.len()).min().unwrap_or_default();
        let fewest_tokens = fewest_views * tokens_per_view;
        let counts = eval.storage.iter().map(|count| ("eval.storage", count));
        for (key, count) in counts.chain([("eval.validation_storage", &eval.validation_storage)]) {
            if count.of(fewest_tokens).is_err() {
                let fix = format!("write at most {fewest_tokens}, the fewest tokens of an evaluated scene");
                return Err(TrainError::BadConfig { key: key.into(), value: count.to_string(), fix });
            }
        }
        let most_stored =
            eval.storage.iter().filter_map(|count| count.of(fewest_tokens).ok()).max().unwrap_or_default();
        // Where no scene stores more tokens than are to be drawn, a count would be left out in silence.
        for count in &eval.render {
            if count.of(most_stored).is_ok_and(|rendered| rendered < most_stored) {
                continue;
            }
            let fix = format!("write less than {most_stored}, the most tokens that every scene stores");
            return Err(TrainError::BadConfig { key: "eval.render".into(), value: count.to_string(), fix });
        }
        Ok(Self { config, reader, items, ledger, device: device.clone() })
    }

    /// Measures a model without autodiff during training: all tokens in stage 1, one count of condensed ones in stage 2.
    /// Writes the first sheet to `folder`. Returns the mean PSNR; none where nothing could be measured, and once `stop` is
    /// set.
    ///
    /// # Errors
    /// As [`evaluate_scene`]; a scene that cannot be read is skipped.
    pub fn validate(
        &self,
        model: &Clift,
        stage: Stage,
        step: u64,
        folder: &Path,
        stop: &AtomicBool,
        sink: &mut dyn Sink,
    ) -> Result<Option<f64>, TrainError> {
        let _precision = self.config.eval.precision.scope();
        let grouping = self.config.clusters.grouping;
        let (storage, variant) = match stage {
            Stage::Stage2 => (self.config.eval.validation_storage, condensed_variant(grouping)),
            _ => (TokenCount::Share(1.0), Variant::Kmeans),
        };
        let sweep = sweep(self.config, vec![storage], vec![variant]);
        let first_format = sweep.tokens[..1].to_vec();
        let sweep = Sweep { render: Vec::new(), tokens: first_format, ..sweep };
        let mut networks = Networks {
            encoder: model.encoder.clone(),
            lift_norm: model.lift_norm.clone(),
            renderer: model.renderer.clone(),
            condensed: None,
            patch_condensed: None,
            device: self.device.clone(),
        };
        networks.set_condensed(grouping, Condensed::of(model));
        let mut measured = EvalResults::default();
        for (i, item) in self.items.iter().take(self.config.eval.num_validation_scenes).enumerate() {
            if stop.load(Ordering::Relaxed) {
                return Ok(None);
            }
            let outcome = self.evaluate_item(&networks, item, &sweep, i == 0, &mut measured, sink)?;
            if let Outcome::Measured(Some(shown)) = outcome {
                std::fs::create_dir_all(folder).map_err(TrainError::io("making a folder", folder))?;
                shown.sheet.write_png(&folder.join(format!("step-{step:09}.png")))?;
            }
        }
        let summary = Summary::new(&measured);
        let Some(point) = summary.points.first() else { return Ok(None) };
        let (psnr, ssim) = (point.psnr.unwrap_or(f64::NAN), point.ssim);
        sink.event(&Event::Evaluated { stage, step, psnr, ssim, num_views: summary.num_views });
        Ok(point.psnr.filter(|psnr| psnr.is_finite()))
    }

    /// Runs the whole sweep and writes `report.html`, `summary.json`, `scenes.csv`, `views.csv`, `skipped.json` and the
    /// picture sheets to `folder`. The pictures of `systems` are scored beside it.
    ///
    /// # Errors
    /// As [`evaluate_scene`]; scenes that cannot be read are skipped and counted.
    /// [`TrainError::Abandoned`] once `stop` is set, [`EvalError::NoPredictions`] for a system without any picture.
    pub fn evaluate(
        &self,
        networks: &Networks,
        systems: &[System],
        folder: &Path,
        stop: &AtomicBool,
        sink: &mut dyn Sink,
    ) -> Result<Summary, TrainError> {
        let _precision = self.config.eval.precision.scope();
        let started = std::time::Instant::now();
        let mut measured = EvalResults::default();
        let lpips = self.lpips(&mut measured, sink)?;
        let sweep = sweep(self.config, self.config.eval.storage.clone(), self.variants(networks)?);
        let sweep = Sweep { lpips, systems: systems.to_vec(), ..sweep };
        let total = self.items.len() as u64;
        sink.event(&Event::StageStarted { stage: Stage::Eval, done: 0, num_steps: total });
        let mut ledger = self.ledger.clone();
        for skip in &ledger.skips {
            measured.skip(&skip.key);
        }
        let sheets = Sheets::new(folder)?;
        let mut exhibits = Vec::new();
        for (i, item) in self.items.iter().enumerate() {
            if stop.load(Ordering::Relaxed) {
                let work = format!("the evaluation, after {i} of {total} scenes");
                return Err(TrainError::Abandoned { work });
            }
            let is_shown = i < self.config.eval.num_sheets;
            let key = self.reader.source.key(item.scene);
            match self.evaluate_item(networks, item, &sweep, is_shown, &mut measured, sink)? {
                Outcome::Measured(None) => {}
                Outcome::Measured(Some(shown)) => {
                    let Shown { sheet, exhibit } = *shown;
                    sheets.add(&sheet, key)?;
                    if exhibits.len() < MAX_EXHIBITS {
                        exhibits.push(exhibit);
                    }
                }
                Outcome::Skipped(reason) => ledger.skip(key, reason),
            }
            sink.event(&Event::Progress { stage: Stage::Eval, done: i as u64 + 1, total });
        }
        let summary = Summary::new(&measured);
        if summary.num_views == 0 {
            return Err(TrainError::NoScenes { reason: "every scene of the evaluation failed".into() });
        }
        for system in systems {
            self.require_pictures(system, &summary)?;
        }
        sheets.keep()?;
        summary.write(&folder.join("summary.json"))?;
        write_scenes(&measured, &folder.join("scenes.csv"))?;
        measured.write_views(&folder.join("views.csv"))?;
        write_ledger(&ledger, &folder.join("skipped.json"))?;
        self.report(&summary, ledger, exhibits)?.write(&folder.join("report.html"))?;
        sink.event(&Event::StageFinished { stage: Stage::Eval, elapsed_s: started.elapsed().as_secs_f64() });
        Ok(summary)
    }

    /// LPIPS, or a note why it is not measured.
    fn lpips(&self, measured: &mut EvalResults, sink: &mut dyn Sink) -> Result<Option<Lpips>, TrainError> {
        let data = &self.config.data;
        let reason = match self.config.eval.lpips_path() {
            _ if data.width.min(data.height) < LPIPS_MIN_SIZE_PX => {
                format!("pictures are below {LPIPS_MIN_SIZE_PX} x {LPIPS_MIN_SIZE_PX} pixels")
            }
            Some(path) => {
                let lpips = Lpips::load(path, &self.device)?;
                sink.event(&Event::Message(format!("LPIPS: weights with SHA-256 {}", lpips.sha256())));
                measured.set_lpips_weights(lpips.sha256());
                return Ok(Some(lpips));
            }
            None => format!("eval.lpips_weights is not set; `{LPIPS_COMMAND}` makes the file"),
        };
        measured.note_not_measured("lpips_vgg", reason);
        Ok(None)
    }

    /// A folder without a single picture is a mistake of the path, not a system that misses all.
    fn require_pictures(&self, system: &System, summary: &Summary) -> Result<(), TrainError> {
        if summary.points.iter().any(|point| point.variant == system.setting().variant) {
            return Ok(());
        }
        let first = self.items.first().and_then(|item| {
            let frame = item.views.target.first()?;
            Some(picture_name(self.reader.source.key(item.scene), *frame))
        });
        let (name, first, path) = (system.name.as_str(), first.unwrap_or_default(), system.folder.clone());
        Err(EvalError::NoPredictions { name, expected: summary.num_views, first, path }.into())
    }

    fn report(&self, summary: &Summary, ledger: Ledger, exhibits: Vec<Exhibit>) -> Result<Report, TrainError> {
        let run_dir = &self.config.run_dir;
        let name = run_dir.file_name().unwrap_or(run_dir.as_os_str()).to_string_lossy().into_owned();
        let config = toml::to_string_pretty(self.config).map_err(TrainError::bad_file("config", run_dir))?;
        let device = self.config.device.to_string();
        Ok(Report { name, summary: summary.clone(), ledger, exhibits, config, device })
    }

    /// What could not be chosen.
    pub fn ledger(&self) -> &Ledger {
        &self.ledger
    }

    /// The variants that are asked for, or all there are weights for.
    fn variants(&self, networks: &Networks) -> Result<Vec<Variant>, TrainError> {
        let asked = &self.config.eval.variants;
        if asked.is_empty() {
            return Ok(networks.variants());
        }
        match asked.iter().find(|variant| !networks.can_draw(**variant)) {
            None => Ok(asked.clone()),
            Some(variant) => {
                let fix = match variant {
                    Variant::Clift => "stage 2 was not trained on clusters of K-means: leave it out".into(),
                    Variant::PatchClift => {
                        "stage 2 was not trained on tiles: train a run with clusters.grouping = \"tile\" and \
                         stage1.init_from this one, and evaluate it with --with"
                            .into()
                    }
                    _ => "baselines are always measured: leave it out".to_owned(),
                };
                Err(TrainError::BadConfig { key: "eval.variants".into(), value: variant.name().into(), fix })
            }
        }
    }

    fn evaluate_item(
        &self,
        networks: &Networks,
        item: &EvaluationItem,
        sweep: &Sweep,
        is_shown: bool,
        measured: &mut EvalResults,
        sink: &mut dyn Sink,
    ) -> Result<Outcome, TrainError> {
        match self.reader.read(item.scene, &item.views) {
            Ok(clip) => {
                let results = evaluate_scene(networks, &clip, sweep, is_shown, measured)?;
                let shown = results.map(|results| Shown::new(&clip, &results, sweep.model.patch_size)).transpose()?;
                Ok(Outcome::Measured(shown.map(Box::new)))
            }
            Err(error) => {
                let key = self.reader.source.key(item.scene);
                measured.skip(key);
                let reason = error.to_string();
                sink.event(&Event::Skipped { key: key.into(), reason: reason.clone() });
                Ok(Outcome::Skipped(reason))
            }
        }
    }
}

/// The variant that a condenser trained on such groups draws.
const fn condensed_variant(grouping: Grouping) -> Variant {
    match grouping {
        Grouping::Kmeans => Variant::Clift,
        Grouping::Tile => Variant::PatchClift,
    }
}

/// What became of one scene.
enum Outcome {
    /// Measured, with its pictures where they are shown.
    Measured(Option<Box<Shown>>),
    /// Could not be read; the reason.
    Skipped(String),
}

/// Writes which scenes were left out, and why.
///
/// # Errors
/// [`TrainError::Io`].
pub fn write_ledger(ledger: &Ledger, path: &Path) -> Result<(), TrainError> {
    let text = serde_json::to_vec_pretty(ledger).map_err(TrainError::bad_file("ledger", path))?;
    replace(path, &text).map_err(TrainError::io("writing what was left out", path))
}

/// The picture sheets of an evaluation, which take the place of those of a former one in the same folder.
struct Sheets {
    folder: PathBuf,
    files: Unfinished,
    /// Names that sheets of the former one have.
    former: Vec<String>,
}

impl Sheets {
    fn new(evaluation: &Path) -> Result<Self, TrainError> {
        let folder = evaluation.join("sheets");
        let files = Unfinished::new(&folder).map_err(TrainError::io("making a folder", &folder))?;
        // Its table names its scenes. What else is in the folder is somebody's.
        let table = std::fs::read_to_string(evaluation.join("scenes.csv")).unwrap_or_default();
        let mut keys: Vec<&str> = table.lines().skip(1).filter_map(|line| line.split(',').next()).collect();
        keys.dedup();
        Ok(Self { folder, files, former: keys.into_iter().map(sheet_name).collect() })
    }

    fn add(&self, sheet: &Picture, key: &str) -> Result<(), TrainError> {
        Ok(sheet.write_png(&self.files.path().join(sheet_name(key)))?)
    }

    fn keep(self) -> Result<(), TrainError> {
        let Self { folder, files, former } = self;
        let replace = || {
            let kept = files.keep()?;
            for name in former.iter().filter(|name| !kept.contains(OsStr::new(name))) {
                match std::fs::remove_file(folder.join(name)) {
                    Err(error) if error.kind() != ErrorKind::NotFound => return Err(error),
                    _ => {}
                }
            }
            Ok(())
        };
        replace().map_err(TrainError::io("writing the sheets", &folder))
    }
}

fn sheet_name(key: &str) -> String {
    format!("{}.png", file_name(key))
}

/// What an evaluation of a run does with every scene; LPIPS and other systems are to be added.
pub(crate) fn sweep(config: &Config, storage: Vec<TokenCount>, variants: Vec<Variant>) -> Sweep {
    let Config { seed, eval, clusters, model, device, .. } = config;
    Sweep {
        storage,
        render: eval.render.clone(),
        selection: eval.selection,
        tokens: eval.tokens.clone(),
        variants,
        kmeans: clusters.kmeans.clone(),
        model: model.clone(),
        lpips: None,
        systems: Vec::new(),
        is_cpu: matches!(device, DeviceName::Flex | DeviceName::Ndarray),
        seed: derive_seed(*seed, "eval"),
    }
}
