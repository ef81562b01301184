//! A run: its directory, resumption, and the order of its stages.

use std::path::PathBuf;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use burn::module::Module;
use burn::tensor::Device;
use clift_data::{
    ClipReader, DataConfig, OpenedSource, SceneSource, SceneSubset, SourceKind, Split, open_dataset,
    open_training_dataset,
};
use clift_eval::{EvalFrames, EvalModels, EvalSplit, Summary, write_skip_report};
use clift_model::{
    LPIPS_COMMAND, ModelPath, Network, TrainedModel, check_sizes, load_part, save_part, save_weights, weights_hash,
};
use clift_scene::TokenCodec;

use crate::cluster_cache::builder::ClusterBuilder;
use crate::cluster_cache::cache::ClusterCache;
use crate::cluster_cache::resume_log::remove_resume_log;
use crate::config::config::Config;
use crate::distributed::machine::open_device;
use crate::distributed::parts::BatchParts;
use crate::distributed::ranks::Ranks;
use crate::error::{TrainError, bad};
use crate::events::{Event, RunStep, Sink, Stage};
use crate::fit_token_codec::ensure_codec;
use crate::footprint::largest_tensor;
use crate::run::eval_folder::{EvalFolder, SUMMARY, read_finished};
use crate::run::evaluate_model::{open_stage2, open_whole};
use crate::run::init_from::{init_from, stage2_weights};
use crate::run::lock::{LockedFolder, RunLock};
use crate::run::run_file::{RunFile, RunOptions, open_folder, require_run};
use crate::run::stage_plan::{MakeBatch, StagePlan};
use crate::run::train_loop::train_stage;
use crate::run::training_data::TrainingData;
use crate::run::validation::{EvalRequest, Validation};
use crate::stage::settings::StageSettings;
use crate::stage::stage1_batches::Stage1Batches;
use crate::stage::stage2_batches::Stage2Batches;

/// An open run.
pub struct Run {
    config: Config,
    overfit: Option<usize>,
    device: Device,
    /// Whether `config` reads the data set that the run was trained on.
    is_training_data: bool,
    /// `None` for a run opened for evaluation, and on ranks other than 0.
    lock: Option<RunLock>,
    ranks: Rc<Ranks>,
}

impl Run {
    /// Opens the run directory of a config, new or existing, and writes the resolved config to it. The directory is locked
    /// until the run is dropped.
    ///
    /// # Errors
    /// [`TrainError::OtherRun`] if the directory contains a run with other settings, [`TrainError::Locked`] if another process
    /// uses it, and those of config, device and disk.
    pub fn open(config: Config, options: &RunOptions, sink: &mut dyn Sink) -> Result<Self, TrainError> {
        Self::open_on(Rc::new(Ranks::single()), config, options, sink)
    }

    /// Opens the run directory of a config on several ranks. All ranks read the directory; rank 0 writes to it.
    ///
    /// # Errors
    /// As [`Run::open`], and those of the other ranks.
    pub fn open_on(
        ranks: Rc<Ranks>,
        mut config: Config,
        options: &RunOptions,
        sink: &mut dyn Sink,
    ) -> Result<Self, TrainError> {
        if options.overfit.is_some() {
            // The training scenes themselves are evaluated.
            config.data.hold_out = 0;
        }
        config.validate()?;
        config.validate_half_resolution()?;
        let (device, places) = open_device(config.device, &ranks)?;
        for place in places {
            sink.event(&Event::Message(place));
        }
        config.precision.check("precision", &device)?;
        config.eval.precision.check("eval.precision", &device)?;
        if let Some(only) = options.only.filter(|only| !config.run_steps().contains(only)) {
            let architecture = config.model.architecture;
            let fix =
                format!("model.architecture = \"{architecture}\" has one stage: write stage1, or leave --only out");
            return Err(bad("--only", only.name(), &fix));
        }
        largest_tensor::check_tensors(&config, &device, config.run_steps())?;
        // Missing weights are reported now, not after days of training.
        config.loss.weights()?;
        if let Some(path) = config.eval.lpips_path().filter(|path| !path.is_file()) {
            let fix = format!("file not found; make it with `{LPIPS_COMMAND}`, or write \"\" to skip LPIPS");
            return Err(bad("eval.lpips_weights", path.display(), &fix));
        }
        let mut lock = None;
        // Rank 0 alone writes.
        ranks.from_root(|| {
            lock = Some(open_folder(&config, options, sink)?);
            Ok(())
        })?;
        let text = toml::to_string(&config).map_err(TrainError::bad_file("config", &config.run_dir))?;
        ranks.require_same("the configs", &text)?;
        Ok(Self { config, overfit: options.overfit, device, is_training_data: true, lock, ranks })
    }

    /// Opens an existing run for evaluation.
    ///
    /// # Errors
    /// [`TrainError::BadFile`] for a damaged `run.json`, [`TrainError::Model`] for other heads than those of the run, and those
    /// of the device.
    pub fn reopen(mut config: Config) -> Result<Self, TrainError> {
        let trained = TrainingData::read(&config.run_dir)?;
        config.data.hold_out = trained.hold_out;
        let is_training_data = trained.is_of(&config);
        config.validate()?;
        check_sizes(&config.model, &config.run_dir)?;
        let run = RunFile::read(&config.run_dir)?;
        let device = config.device.open()?;
        Ok(Self { config, overfit: run.overfit, device, is_training_data, lock: None, ranks: Ranks::single().into() })
    }

    /// Trains the remaining steps of the run, or of one stage, and evaluates. Returns the evaluation of a whole run, on rank
    /// 0; the existing one if the run was trained and evaluated before.
    ///
    /// # Errors
    /// [`TrainError::Missing`] if `only` is a stage whose predecessor has not run, and those of the stages.
    pub fn train(
        &self,
        only: Option<RunStep>,
        stop: &AtomicBool,
        sink: &mut dyn Sink,
    ) -> Result<Option<Summary>, TrainError> {
        let summary = self.folder("eval").join(SUMMARY);
        // Rank 0 looks at the files for all.
        let has_weights = || Ok([Stage::Stage1, Stage::Stage2].map(|stage| self.weights(stage).exists()));
        let [has_stage1, has_stage2] = self.ranks.from_root(has_weights)?;
        let is_trained = has_stage1 && (has_stage2 || !self.config.stages().contains(&Stage::Stage2));
        if self.ranks.from_root(|| Ok(only.is_none() && is_trained && summary.exists()))? {
            return self.ranks.is_root().then(|| read_finished(&self.config.run_dir, sink)).transpose();
        }
        if self.ranks.is_root() && !is_trained && summary.exists() {
            // Of former weights, of stage 1 alone.
            std::fs::remove_file(&summary).map_err(TrainError::io("removing the former evaluation", &summary))?;
        }
        let steps: [(RunStep, bool, MakeStep<'_>); 5] = [
            (Stage::Stage1.into(), has_stage1, Training::train_stage1),
            (RunStep::Clusters, has_stage2 && only.is_none(), Training::make_clusters),
            (Stage::Stage2.into(), has_stage2, Training::train_stage2),
            // The codec of stage 2 is fitted where it is missing.
            (Stage::Stage2.into(), false, Training::fit_codec),
            (RunStep::Eval, false, Training::evaluate),
        ];
        let run_steps = self.config.run_steps();
        let is_wanted = |step: RunStep| run_steps.contains(&step) && only.is_none_or(|only| only == step);
        let mut training = self.open_training(stop, sink)?;
        if is_wanted(Stage::Stage2.into()) && !has_stage2 {
            self.check_init_from()?;
        }
        for (step, is_done, make) in steps {
            if is_wanted(step) && !is_done {
                make(&mut training, sink)?;
            }
        }
        Ok(training.summary)
    }

    /// Opens the data of the steps.
    fn open_training<'a>(&'a self, stop: &'a AtomicBool, sink: &mut dyn Sink) -> Result<Training<'a>, TrainError> {
        self.report_opening(Split::Train, sink);
        let mut progress = |done, total| sink.event(&Event::Scan { done, total });
        let further = &self.config.stage1.further_sizes;
        let min_size = [0, 1].map(|side| further.iter().map(|size| size[side]).max().unwrap_or_default());
        let data = DataConfig { min_size, ..self.config.data.clone() };
        let opened = open_training_dataset(&data, self.config.last_gap_step(), &mut progress)?;
        let is_divided = self.is_divided(&opened);
        let reader = self.reader(opened, Split::Train, sink)?;
        let mut validation = self.validation(Split::Test, sink)?;
        if is_divided && let Some(warning) = validation.mark_training_scenes(reader.source.as_ref()) {
            sink.event(&Event::Warning(warning));
        }
        Ok(Training { run: self, reader, validation, stop, stage1: None, clusters: None, summary: None })
    }

    /// Finds a wrong `stage2.init_from` before the stages take their time.
    fn check_init_from(&self) -> Result<(), TrainError> {
        let needs_start = self.config.stage2.weight_interpolation < 1.0;
        if needs_start || !self.folder("stage2").join("checkpoints").exists() {
            init_from(self.new_model(), &self.config, Stage::Stage2, &mut |_: &Event| {})?;
        }
        Ok(())
    }

    /// Evaluates the run. `beside` are other runs, evaluated on the same views: one with the same stage 1 whose stage 2 was
    /// trained on other groups of tokens, and runs of networks without clusters, with distinct numbers of
    /// tokens.
    ///
    /// # Errors
    /// [`TrainError::Missing`] without the weights of stage 1, [`TrainError::OtherEncoder`] if stage 2 was trained on another
    /// encoder, [`TrainError::Locked`] if `folder` is in a run directory that another process uses, and those of the evaluation.
    pub fn evaluate(
        &self,
        request: &EvalRequest,
        beside: &[Config],
        stop: &AtomicBool,
        sink: &mut dyn Sink,
    ) -> Result<Summary, TrainError> {
        let run_dir = &self.config.run_dir;
        let is_inside = self.lock.is_none() && request.folder.is_in(run_dir);
        let _lock = is_inside.then(|| RunLock::take(run_dir, LockedFolder::EvaluatedRun, sink)).transpose()?;
        let mut models = self.models(sink)?;
        for other in beside {
            if !other.model.architecture.supports_clusters() {
                models.whole.push(open_whole(&self.config, other, &models.whole, &self.device)?);
                continue;
            }
            if other.clusters.grouping == self.config.clusters.grouping {
                let fix = "its stage 2 was trained on the same groups of tokens: choose a run with another \
                           clusters.grouping";
                return Err(bad("--with", other.run_dir.display(), fix));
            }
            models.set_stage2(other.clusters.grouping, open_stage2(other, &models.stage1)?);
        }
        let mut validation = self.validation(request.split, sink)?;
        if request.split == Split::Test && self.is_training_data {
            let mut progress = |done, total| sink.event(&Event::Scan { done, total });
            let training = open_training_dataset(&self.config.data, self.config.last_gap_step(), &mut progress);
            // The training split need not be on this machine.
            if let Some(training) = training.ok().filter(|opened| self.is_divided(opened))
                && let Some(warning) = validation.mark_training_scenes(training.source.as_ref())
            {
                sink.event(&Event::Warning(warning));
            }
        }
        if !self.is_training_data {
            validation.check_contexts();
        }
        validation.evaluate(&models, request, &self.ranks, stop, sink)
    }

    /// Whether training and test scenes of files are lists of their own, which should have no scene in common.
    fn is_divided(&self, opened: &OpenedSource) -> bool {
        opened.kind != SourceKind::Synthetic && !opened.shares_scenes && self.overfit.is_none()
    }

    /// Opens the trained models of both stages, or of stage 1 only.
    fn models(&self, sink: &mut dyn Sink) -> Result<EvalModels, TrainError> {
        let weights = self.require_stage1(RunStep::Eval)?;
        let path = ModelPath { dir: self.config.run_dir.clone(), weights };
        let mut models = EvalModels::new(TrainedModel::open_with(&path, &self.config.model, &self.device)?);
        if self.weights(Stage::Stage2).exists() {
            let stage2 = open_stage2(&self.config, &models.stage1)?;
            models.codec = TokenCodec::beside(&self.weights(Stage::Stage2), &stage2)?.map(Arc::new);
            models.set_stage2(self.config.clusters.grouping, stage2);
        } else if self.config.stages().contains(&Stage::Stage2) {
            sink.event(&Event::Message("stage 2 has not run: evaluating only the weights of stage 1".into()));
        }
        Ok(models)
    }

    /// Opens the evaluated views of a split.
    fn validation(&self, split: Split, sink: &mut dyn Sink) -> Result<Validation<'_>, TrainError> {
        let mut eval = self.config.eval.clone();
        if self.overfit.is_some() && eval.index.take().is_some() {
            sink.event(&Event::Message("--overfit evaluates the training scenes: eval.index is not used".into()));
        }
        self.report_opening(split, sink);
        let data = &self.config.data;
        let mut progress = |done, total| sink.event(&Event::Scan { done, total });
        let (opened, split, frames) = if self.overfit.is_some() {
            let opened = open_training_dataset(data, self.config.stage1.steps, &mut progress)?;
            (opened, Split::Train, EvalFrames::whole(EvalSplit::Train))
        } else {
            let opened = open_dataset(data, split, &mut progress)?;
            let frames = EvalFrames::new(&opened, split, data.hold_out, self.is_training_data);
            (opened, split, frames)
        };
        let reader = self.reader(opened, split, sink)?;
        Validation::new(&self.config, eval, reader, frames, &self.device, sink)
    }

    fn parts(&self, stage: Stage) -> BatchParts {
        let StageSettings { batch_size, accumulate, .. } = self.config.stage(stage);
        BatchParts::new(batch_size, accumulate, &self.ranks)
    }

    fn plan(&self, stage: Stage, batches: Arc<MakeBatch>) -> StagePlan<'_> {
        StagePlan {
            settings: self.config.stage(stage),
            batches,
            config: &self.config,
            folder: self.folder(stage.name()),
            device: self.device.clone().autodiff(),
            ranks: &self.ranks,
            parts: self.parts(stage),
        }
    }

    fn new_model(&self) -> Network {
        Network::new(&self.config.model, self.config.seed, &self.device.clone().autodiff())
    }

    /// Opens the cluster cache of an encoder; `None` if it is not built.
    fn open_clusters(&self, encoder_hash: &str) -> Result<Option<ClusterCache>, TrainError> {
        let folder = self.folder("clusters");
        let is_built = self.ranks.from_root(|| {
            let is_built = folder.exists();
            if is_built {
                remove_resume_log(&folder)?;
            }
            Ok(is_built)
        })?;
        is_built.then(|| ClusterCache::open(&folder, &self.config, encoder_hash)).transpose()
    }

    /// Loads the model of stage 1, which `step` needs.
    fn load_stage1(&self, step: RunStep) -> Result<Network, TrainError> {
        let path = self.require_stage1(step)?;
        let mut model = self.new_model();
        load_part(&mut model, &Network::stage1_part(), &path)?.require_all(&path)?;
        Ok(model)
    }

    /// Returns the path of the stage-1 weights, which `step` needs.
    fn require_stage1(&self, step: RunStep) -> Result<PathBuf, TrainError> {
        let path = self.weights(Stage::Stage1);
        if path.exists() {
            return Ok(path);
        }
        let what = "the weights of stage 1";
        Err(TrainError::Missing { stage: step.name(), what, first: "--only stage1", path })
    }

    /// Reports that a data set is opened: the first time, thousands of files are read.
    fn report_opening(&self, split: Split, sink: &mut dyn Sink) {
        if let Some(root) = &self.config.data.root {
            sink.event(&Event::Message(format!("{split}: opening {}", root.display())));
        }
    }

    fn reader(&self, opened: OpenedSource, split: Split, sink: &mut dyn Sink) -> Result<ClipReader, TrainError> {
        let OpenedSource { source, report, .. } = opened;
        sink.event(&Event::Message(format!("{split}: {report}")));
        if self.lock.is_some() && report.has_skips() {
            write_skip_report(&report, &self.folder(&format!("skipped-{split}.json")))?;
        }
        let source: Arc<dyn SceneSource> = match self.overfit {
            Some(count) => Arc::new(SceneSubset::first(source, count)),
            None => source,
        };
        Ok(ClipReader { source, options: self.config.data.clip_options() })
    }

    fn folder(&self, name: &str) -> PathBuf {
        self.config.run_dir.join(name)
    }

    fn weights(&self, stage: Stage) -> PathBuf {
        self.folder(stage.name()).join("model.safetensors")
    }
}

/// Makes a step of a run.
type MakeStep<'a> = fn(&mut Training<'a>, &mut dyn Sink) -> Result<(), TrainError>;

/// What the steps of a training share: the data, and the results of the steps made so far.
struct Training<'a> {
    run: &'a Run,
    reader: ClipReader,
    validation: Validation<'a>,
    stop: &'a AtomicBool,
    /// The model of stage 1, if this process has trained or loaded it.
    stage1: Option<Network>,
    /// The cluster cache, if this process has made or opened it.
    clusters: Option<ClusterCache>,
    /// The evaluation, on rank 0.
    summary: Option<Summary>,
}

impl Training<'_> {
    fn train_stage1(&mut self, sink: &mut dyn Sink) -> Result<(), TrainError> {
        let Self { run, reader, validation, stop, .. } = self;
        let batches = Stage1Batches::new(&run.config, reader, run.parts(Stage::Stage1))?;
        let plan = run.plan(Stage::Stage1, Arc::new(move |step| batches.batch(step)));
        let start = |sink: &mut dyn Sink| init_from(run.new_model(), &run.config, Stage::Stage1, sink);
        let model = train_stage(&plan, start, validation, stop, sink)?;
        run.ranks.from_root(|| Ok(save_part(&model, &Network::stage1_part(), &run.weights(Stage::Stage1))?))?;
        self.stage1 = Some(model);
        Ok(())
    }

    /// Opens the cluster cache, or builds it.
    fn make_clusters(&mut self, sink: &mut dyn Sink) -> Result<(), TrainError> {
        let model = self.take_stage1(RunStep::Clusters)?;
        let Self { run, reader, stop, .. } = self;
        let encoder_hash = &weights_hash(&model.encoder);
        self.clusters = match run.open_clusters(encoder_hash)? {
            None => {
                let (config, device, ranks) = (&run.config, &run.device, &run.ranks);
                let encoder = &model.encoder.valid();
                let builder = ClusterBuilder { config, reader, encoder, encoder_hash, device, ranks };
                Some(builder.build(&run.folder("clusters"), stop, sink)?)
            }
            clusters => clusters,
        };
        self.stage1 = Some(model);
        Ok(())
    }

    fn train_stage2(&mut self, sink: &mut dyn Sink) -> Result<(), TrainError> {
        let stage1 = self.take_stage1(Stage::Stage2.into())?;
        let Self { run, reader, validation, stop, clusters, .. } = self;
        let clusters = match clusters.take() {
            None => run.open_clusters(&weights_hash(&stage1.encoder))?,
            clusters => clusters,
        };
        let Some(clusters) = clusters else {
            let (what, path) = ("the cluster cache", run.folder("clusters"));
            return Err(TrainError::Missing { stage: "stage2", what, first: "--only clusters", path });
        };
        let batches = Stage2Batches::new(&run.config, reader, Arc::new(clusters), run.parts(Stage::Stage2))?;
        let plan = run.plan(Stage::Stage2, Arc::new(move |step| batches.batch(step)));
        // The condenser of stage 1 takes no gradient.
        let start = |sink: &mut dyn Sink| {
            let initial = init_from(run.new_model(), &run.config, Stage::Stage2, sink)?;
            Ok(Network { condenser: initial.condenser, ..stage1 })
        };
        let trained = train_stage(&plan, start, validation, stop, sink)?.valid();
        run.ranks.from_root(|| {
            let model = stage2_weights(&run.config, || run.load_stage1(Stage::Stage2.into()), trained, sink)?;
            Ok(save_weights(&model, &run.weights(Stage::Stage2))?)
        })
    }

    /// Returns the model of stage 1, which `step` needs: the trained one, or that of an earlier process.
    fn take_stage1(&mut self, step: RunStep) -> Result<Network, TrainError> {
        self.stage1.take().map_or_else(|| self.run.load_stage1(step), Ok)
    }

    fn fit_codec(&mut self, sink: &mut dyn Sink) -> Result<(), TrainError> {
        let Self { run, reader, stop, .. } = self;
        if !run.ranks.is_root() {
            return Ok(());
        }
        ensure_codec(&run.config, &run.weights(Stage::Stage2), &run.device, reader, stop, sink)
    }

    fn evaluate(&mut self, sink: &mut dyn Sink) -> Result<(), TrainError> {
        let Self { run, validation, stop, .. } = self;
        // After rank 0 has fitted the codec, which all ranks read.
        run.ranks.from_root(|| require_run(&run.config.run_dir))?;
        let folder = run.folder("eval");
        let folder =
            if run.ranks.is_root() { EvalFolder::open(&folder, true, sink)? } else { EvalFolder::unlocked(folder) };
        let request = EvalRequest { split: Split::Test, external: &[], folder: &folder };
        let summary = validation.evaluate(&run.models(sink)?, &request, &run.ranks, stop, sink)?;
        self.summary = run.ranks.is_root().then_some(summary);
        Ok(())
    }
}

#[cfg(test)]
mod tests;
