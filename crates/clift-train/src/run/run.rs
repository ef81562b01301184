//! A run: its directory, resumption, and the order of its stages.

use std::path::PathBuf;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use burn::module::Module;
use burn::tensor::Device;
use clift_data::{ClipReader, DataConfig, OpenedSource, SourceKind, Split, open_dataset, open_training_dataset};
use clift_eval::{EvalFrames, EvalModels, Summary, write_skip_report};
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
use crate::footprint::largest_tensor::check_tensors;
use crate::run::eval_folder::{EvalFolder, SUMMARY, read_finished};
use crate::run::evaluate_model::{open_stage2, open_whole};
use crate::run::init_from::{init_from, stage2_weights};
use crate::run::lock::{EVALUATED_RUN, RunLock};
use crate::run::run_file::{RunOptions, check_run_file, is_of_training, open_folder, read_run_config, require_run};
use crate::run::train_loop::{MakeBatch, StagePlan, train_stage};
use crate::run::validation::Validation;
use crate::stage::settings::StageSettings;
use crate::stage::stage1_batches::Stage1Batches;
use crate::stage::stage2_batches::Stage2Batches;

/// An open run.
pub struct Run {
    config: Config,
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
    pub fn open_on(
        ranks: Rc<Ranks>,
        config: Config,
        options: &RunOptions,
        sink: &mut dyn Sink,
    ) -> Result<Self, TrainError> {
        config.validate()?;
        config.validate_half_resolution()?;
        let (device, texts) = open_device(config.device, &ranks)?;
        for text in texts {
            sink.event(&Event::Message(text));
        }
        config.precision.check("precision", &device)?;
        config.eval.precision.check("eval.precision", &device)?;
        if let Some(only) = options.only.filter(|only| !config.run_steps().contains(only)) {
            let architecture = config.model.architecture;
            let fix =
                format!("model.architecture = \"{architecture}\" has one stage: write stage1, or leave --only out");
            return Err(bad("--only", only.name(), &fix));
        }
        check_tensors(&config, &device, config.run_steps())?;
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
        Ok(Self { config, device, is_training_data: true, lock, ranks })
    }

    /// Opens an existing run for evaluation.
    ///
    /// # Errors
    /// [`TrainError::BadFile`] for a damaged `run.json`, [`TrainError::Model`] for other heads than those of the run, and those
    /// of the device.
    pub fn reopen(mut config: Config) -> Result<Self, TrainError> {
        let trained = read_run_config(&config.run_dir)?.data;
        config.data.hold_out = trained.hold_out;
        let is_training_data = is_of_training(&trained, &config.data);
        config.validate()?;
        check_sizes(&config.model, &config.run_dir)?;
        check_run_file(&config.run_dir)?;
        let device = config.device.open()?;
        Ok(Self { config, device, is_training_data, lock: None, ranks: Ranks::single().into() })
    }

    /// Trains the remaining steps of the run, or of one stage, and evaluates. Returns the evaluation of a whole run, on rank
    /// 0; the existing one if the run was trained and evaluated before.
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
        let is_trained = has_stage1 && (has_stage2 || !self.config.model.architecture.supports_clusters());
        if self.ranks.from_root(|| Ok(only.is_none() && is_trained && summary.exists()))? {
            return self.ranks.is_root().then(|| read_finished(&self.config.run_dir, sink)).transpose();
        }
        if self.ranks.is_root() && !is_trained && summary.exists() {
            // Of former weights, of stage 1 alone.
            std::fs::remove_file(&summary).map_err(TrainError::io("removing the former evaluation", &summary))?;
        }
        let run_steps = self.config.run_steps();
        let is_wanted = |step: RunStep| run_steps.contains(&step) && only.is_none_or(|only| only == step);
        let training = self.open_training(stop, sink)?;
        let trains_stage2 = is_wanted(Stage::Stage2.into()) && !has_stage2;
        let needs_start = self.config.stage2.weight_interpolation < 1.0;
        if trains_stage2 && (needs_start || !self.folder("stage2").join("checkpoints").exists()) {
            // Finds a wrong `stage2.init_from` before the stages take their time.
            init_from(self.new_model(), &self.config, Stage::Stage2, &mut |_: &Event| {})?;
        }
        if is_wanted(Stage::Stage1.into()) && !has_stage1 {
            training.train_stage1(sink)?;
        }
        if is_wanted(RunStep::Clusters) && !(has_stage2 && only.is_none()) {
            training.make_clusters(sink)?;
        }
        if trains_stage2 {
            training.train_stage2(sink)?;
        }
        if is_wanted(Stage::Stage2.into()) && self.ranks.is_root() {
            // The codec is fitted where it is missing.
            let weights = self.weights(Stage::Stage2);
            ensure_codec(&self.config, &weights, &self.device, &training.reader, stop, sink)?;
        }
        // The other ranks wait at the end of the run.
        let evaluates = is_wanted(RunStep::Eval) && self.ranks.is_root();
        evaluates.then(|| training.evaluate(sink)).transpose()
    }

    fn open_training<'a>(&'a self, stop: &'a AtomicBool, sink: &mut dyn Sink) -> Result<Training<'a>, TrainError> {
        let further = &self.config.stage1.further_sizes;
        let min_size = [0, 1].map(|side| further.iter().map(|size| size[side]).max().unwrap_or_default());
        let data = DataConfig { min_size, ..self.config.data.clone() };
        let mut progress = |done, total| sink.event(&Event::Scan { done, total });
        let opened = open_training_dataset(&data, self.config.last_gap_step(), &mut progress)?;
        let is_divided = is_divided(&opened);
        let reader = self.reader(opened, Split::Train, sink)?;
        let mut validation = self.validation(Split::Test, sink)?;
        if is_divided {
            validation.mark_training_scenes(reader.source.as_ref(), sink);
        }
        Ok(Training { run: self, reader, validation, stop })
    }

    /// Evaluates the run on a split, and writes the results to `folder`. `beside` are other runs, evaluated on the same
    /// views: one with the same stage 1 whose stage 2 was trained on other groups of tokens, and runs of networks without
    /// clusters, with distinct numbers of tokens.
    ///
    /// # Errors
    /// [`TrainError::Missing`] without the weights of stage 1, [`TrainError::OtherEncoder`] if stage 2 was trained on another
    /// encoder, [`TrainError::Locked`] if `folder` is in a run directory that another process uses, and those of the evaluation.
    pub fn evaluate(
        &self,
        (split, folder): (Split, &EvalFolder),
        beside: &[Config],
        stop: &AtomicBool,
        sink: &mut dyn Sink,
    ) -> Result<Summary, TrainError> {
        let run_dir = &self.config.run_dir;
        let is_inside = self.lock.is_none() && folder.is_in(run_dir);
        let _lock = is_inside.then(|| RunLock::take(run_dir, EVALUATED_RUN, sink)).transpose()?;
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
        let mut validation = self.validation(split, sink)?;
        if split == Split::Test && self.is_training_data {
            let mut progress = |done, total| sink.event(&Event::Scan { done, total });
            let training = open_training_dataset(&self.config.data, self.config.last_gap_step(), &mut progress);
            // The training split need not be on this machine.
            if let Some(training) = training.ok().filter(is_divided) {
                validation.mark_training_scenes(training.source.as_ref(), sink);
            }
        }
        // On data that the model was not trained on, the context views may be too far apart: they are rendered, too.
        validation.evaluator.sweep.checks_contexts = !self.is_training_data;
        validation.evaluate(&models, folder, stop, sink)
    }

    fn models(&self, sink: &mut dyn Sink) -> Result<EvalModels, TrainError> {
        let weights = self.require_stage1(RunStep::Eval)?;
        let path = ModelPath { dir: self.config.run_dir.clone(), weights };
        let mut models = EvalModels::new(TrainedModel::open_with(&path, &self.config.model, &self.device)?);
        if self.weights(Stage::Stage2).exists() {
            let stage2 = open_stage2(&self.config, &models.stage1)?;
            models.codec = TokenCodec::beside(&self.weights(Stage::Stage2), &stage2)?.map(Arc::new);
            models.set_stage2(self.config.clusters.grouping, stage2);
        } else if self.config.model.architecture.supports_clusters() {
            sink.event(&Event::Message("stage 2 has not run: evaluating only the weights of stage 1".into()));
        }
        Ok(models)
    }

    fn validation(&self, split: Split, sink: &mut dyn Sink) -> Result<Validation<'_>, TrainError> {
        let data = &self.config.data;
        let mut progress = |done, total| sink.event(&Event::Scan { done, total });
        let opened = open_dataset(data, split, &mut progress)?;
        let frames = EvalFrames::new(&opened, split, data.hold_out, self.is_training_data);
        let reader = self.reader(opened, split, sink)?;
        Validation::new(&self.config, reader, frames, &self.device, sink)
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
        let is_built = self.ranks.from_root(|| Ok(folder.exists()))?;
        is_built.then(|| ClusterCache::open(&folder, &self.config, encoder_hash)).transpose()
    }

    fn load_stage1(&self, step: RunStep) -> Result<Network, TrainError> {
        let path = self.require_stage1(step)?;
        let mut model = self.new_model();
        load_part(&mut model, &Network::stage1_part(), &path)?.require_all(&path)?;
        Ok(model)
    }

    fn require_stage1(&self, step: RunStep) -> Result<PathBuf, TrainError> {
        let path = self.weights(Stage::Stage1);
        if path.exists() {
            return Ok(path);
        }
        let what = "the weights of stage 1";
        Err(TrainError::Missing { stage: step.name(), what, first: "--only stage1", path })
    }

    fn reader(&self, opened: OpenedSource, split: Split, sink: &mut dyn Sink) -> Result<ClipReader, TrainError> {
        let OpenedSource { source, report, .. } = opened;
        sink.event(&Event::Message(format!("{split}: {report}")));
        if self.lock.is_some() && report.has_skips() {
            write_skip_report(&report, &self.folder(&format!("skipped-{split}.json")))?;
        }
        Ok(ClipReader { source, options: self.config.data.clip_options() })
    }

    fn folder(&self, name: &str) -> PathBuf {
        self.config.run_dir.join(name)
    }

    fn weights(&self, stage: Stage) -> PathBuf {
        self.folder(stage.name()).join("model.safetensors")
    }
}

/// Whether training and test scenes of files are lists of their own, which should have no scene in common.
fn is_divided(opened: &OpenedSource) -> bool {
    opened.kind != SourceKind::Synthetic && !opened.shares_scenes
}

struct Training<'a> {
    run: &'a Run,
    reader: ClipReader,
    validation: Validation<'a>,
    stop: &'a AtomicBool,
}

impl Training<'_> {
    fn train_stage1(&self, sink: &mut dyn Sink) -> Result<(), TrainError> {
        let Self { run, reader, validation, stop } = self;
        let batches = Stage1Batches::new(&run.config, reader, run.parts(Stage::Stage1))?;
        let plan = run.plan(Stage::Stage1, Arc::new(move |step| batches.batch(step)));
        let start = |sink: &mut dyn Sink| init_from(run.new_model(), &run.config, Stage::Stage1, sink);
        let model = train_stage(&plan, start, validation, stop, sink)?;
        run.ranks.from_root(|| Ok(save_part(&model, &Network::stage1_part(), &run.weights(Stage::Stage1))?))
    }

    fn make_clusters(&self, sink: &mut dyn Sink) -> Result<(), TrainError> {
        let Self { run, reader, stop, .. } = self;
        let Run { config, device, ranks, .. } = run;
        let encoder = &run.load_stage1(RunStep::Clusters)?.encoder.valid();
        let (folder, encoder_hash) = (run.folder("clusters"), &weights_hash(encoder));
        ranks.from_root(|| if folder.exists() { remove_resume_log(&folder) } else { Ok(()) })?;
        if run.open_clusters(encoder_hash)?.is_none() {
            ClusterBuilder { config, reader, encoder, encoder_hash, device, ranks }.build(&folder, stop, sink)?;
        }
        Ok(())
    }

    fn train_stage2(&self, sink: &mut dyn Sink) -> Result<(), TrainError> {
        let Self { run, reader, validation, stop } = self;
        let stage1 = run.load_stage1(Stage::Stage2.into())?;
        let Some(clusters) = run.open_clusters(&weights_hash(&stage1.encoder))? else {
            let (what, path) = ("the cluster cache", run.folder("clusters"));
            return Err(TrainError::Missing { stage: "stage2", what, first: "--only clusters", path });
        };
        let batches = Stage2Batches::new(&run.config, reader, clusters, run.parts(Stage::Stage2))?;
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

    fn evaluate(&self, sink: &mut dyn Sink) -> Result<Summary, TrainError> {
        let Self { run, validation, stop, .. } = self;
        require_run(&run.config.run_dir)?;
        let folder = EvalFolder::open(&run.folder("eval"), true, sink)?;
        validation.evaluate(&run.models(sink)?, &folder, stop, sink)
    }
}

#[cfg(test)]
mod tests;
