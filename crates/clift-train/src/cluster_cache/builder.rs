//! Builds the cluster cache: latent K-means of the frozen encoder's tokens, or tiles, for every training scene.
//!
//! A log stores the finished entries; an interrupted build resumes from it.

use std::io::ErrorKind;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use burn::tensor::Device;
use clift_core::{derive_seed, item_rng, uniform_below};
use clift_data::{ClipReader, DataError, ViewIndices};
use clift_model::{Encoder, SceneClusters, Views};

use crate::cluster_cache::cache::{CacheSettings, VERSION};
use crate::cluster_cache::resume_log::{CacheKey, Outcome, ResumeLog};
use crate::config::config::{ClustersConfig, Config};
use crate::distributed::ranks::Ranks;
use crate::error::TrainError;
use crate::events::{Event, RunStep, Sink};

pub struct ClusterBuilder<'a> {
    pub config: &'a Config,
    pub reader: &'a ClipReader,
    /// The trained encoder, without autodiff.
    pub encoder: &'a Encoder,
    pub encoder_hash: &'a str,
    pub device: &'a Device,
    pub ranks: &'a Ranks,
}

impl ClusterBuilder<'_> {
    /// Clusters every training scene `num_passes` times, each time with one context set and one count of the grid.
    /// Resumes an interrupted build with the same encoder and settings; the bytes do not depend on interruptions.
    /// The cache is written to a temporary folder, which is then renamed. Scenes that cannot be used are skipped.
    pub fn build(&self, folder: &Path, stop: &AtomicBool, sink: &mut dyn Sink) -> Result<(), TrainError> {
        let Self { config, reader, encoder_hash, ranks, .. } = *self;
        // Rank 0 alone writes.
        let mut log = None;
        let done = ranks.from_root(|| {
            let cache_key =
                CacheKey { version: VERSION, encoder: encoder_hash.into(), settings: CacheSettings::new(config) };
            let opened = ResumeLog::open(&folder.with_extension("tmp"), cache_key)?;
            Ok(log.insert(opened).num_sets())
        })?;

        let total = reader.source.num_scenes();
        let num_scenes = if config.clusters.num_scenes == 0 { total } else { config.clusters.num_scenes.min(total) };
        let total_sets = (config.clusters.num_passes * num_scenes) as u64;
        let started = std::time::Instant::now();
        sink.event(&Event::StepStarted { run_step: RunStep::Clusters, done, num_steps: total_sets });
        for first in (done..total_sets).step_by(ranks.num_ranks()) {
            let set = first + ranks.rank() as u64;
            let cluster = || self.cluster_or_skip(set / num_scenes as u64, set as usize % num_scenes);
            let own = (set < total_sets).then(cluster).transpose()?;
            let all = ranks.gather((own, stop.load(Ordering::Relaxed)))?;
            let is_stopped = all.iter().any(|(_, is_stopped)| *is_stopped);
            for (set, outcome) in (first..).zip(all.into_iter().filter_map(|(outcome, _)| outcome)) {
                if let Some(log) = &mut log {
                    if let Outcome::Skipped { key, reason } = &outcome {
                        sink.event(&Event::Skipped { key: key.clone(), reason: reason.clone() });
                    }
                    log.add(&outcome)?;
                }
                sink.event(&Event::Progress { run_step: RunStep::Clusters, done: set + 1, total: total_sets });
            }
            if is_stopped {
                return Err(TrainError::Interrupted { step: total_sets.min(first + ranks.num_ranks() as u64) });
            }
        }
        sink.event(&Event::StepFinished { run_step: RunStep::Clusters, elapsed_s: started.elapsed().as_secs_f64() });
        ranks.from_root(|| log.take().map_or(Ok(()), |log| log.publish(folder, num_scenes)))
    }

    fn cluster_or_skip(&self, pass: u64, scene: usize) -> Result<Outcome, TrainError> {
        let key = self.reader.source.key(scene).to_owned();
        match self.cluster_scene(pass, scene) {
            Ok((context, clusters)) => {
                let short = |ids: &[u32]| {
                    let short = |&id| u16::try_from(id).expect("a config allows at most MAX_TOKENS tokens");
                    ids.iter().map(short).collect()
                };
                let (tokens, centroids) = (short(clusters.assignment()), short(clusters.centroid_index()));
                Ok(Outcome::Clustered { key, context, tokens, centroids })
            }
            Err(TrainError::Data(error)) if is_of_scene(&error) => {
                Ok(Outcome::Skipped { key, reason: error.to_string() })
            }
            Err(other) => Err(other),
        }
    }

    fn cluster_scene(&self, pass: u64, scene: usize) -> Result<(Vec<usize>, SceneClusters), TrainError> {
        let Self { config, reader, encoder, device, .. } = *self;
        let seed = derive_seed(config.seed, "clusters");
        let views = &config.data.views;
        let mut rng = item_rng(seed, pass, scene as u32, 0, "context and count");
        let num_context = views.min_context + uniform_below(&mut rng, views.max_context - views.min_context + 1);
        let step = config.last_gap_step();
        let context = views.sample(reader.source.as_ref(), scene, step, num_context, &mut rng)?.context;
        let clip = reader.read(scene, &ViewIndices { context: context.clone(), target: Vec::new() })?;
        let ClustersConfig { grouping, grid, kmeans, .. } = &config.clusters;
        let num_tokens = config.model.num_tokens(num_context, clip.context.height, clip.context.width)?;
        let count = grid[uniform_below(&mut rng, grid.len())].of(num_tokens)?;
        let patches = [clip.context.height, clip.context.width].map(|side| side / config.model.patch_size);
        // Tokens before the token norm, as in the released code: stage 2 trains this norm.
        let context_views = Views::upload(&[&clip.context], device)?;
        let tokens = || encoder.forward(&context_views).values;
        let kmeans = (kmeans, derive_seed(seed, &clip.key));
        Ok((context, grouping.group(count, (num_context, patches), kmeans, tokens)?))
    }
}

/// Whether an error concerns one scene alone. A failing disk does not.
fn is_of_scene(error: &DataError) -> bool {
    match error {
        DataError::Io { source, .. } => matches!(source.kind(), ErrorKind::NotFound | ErrorKind::PermissionDenied),
        _ => true,
    }
}
