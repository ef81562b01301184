//! The offline cluster cache: latent K-means of every training scene, made once from the frozen encoder, or tiles.
//!
//! A folder with `index.json` (what was clustered with which encoder) and `clusters.bin` (per entry the
//! cluster of every token and the token of every cluster, little-endian u16). While it is made, a journal keeps what is
//! done.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use burn::tensor::Device;
use clift_data::order::{below, derive_seed, item_rng};
use clift_data::{ClipReader, DataError, Ledger, ViewIndices};
use clift_eval::upload_views;
use clift_model::{Encoder, Grouping, SceneClusters, tile_clusters};

use crate::TrainError;
use crate::cluster_entry::{Entry, Index, VERSION};
use crate::cluster_journal::{Journal, Origin};
use crate::config::{ClustersConfig, Config};
use crate::events::{Event, Sink, Stage};

/// What the cache of a run is made from.
pub struct ClusterJob<'a> {
    /// Settings of the run.
    pub config: &'a Config,
    /// Training scenes.
    pub reader: &'a ClipReader,
    /// The trained encoder, without autodiff.
    pub encoder: &'a Encoder,
    /// Its hash.
    pub encoder_hash: &'a str,
    /// Where it lives.
    pub device: &'a Device,
}

impl ClusterJob<'_> {
    /// Clusters every training scene `num_passes` times, each time with one context set and one count
    /// of the grid, and opens the result. What an interrupted call with the same encoder and settings has done is taken
    /// over; the result is the same, byte for byte. Written to a temporary folder that is then renamed.
    ///
    /// # Errors
    /// Whatever the disk or the model gives, [`TrainError::NoScenes`] when no scene could be clustered, and
    /// [`TrainError::Interrupted`]. A scene that does not fit its views is skipped and noted.
    pub fn make(&self, folder: &Path, stop: &AtomicBool, sink: &mut dyn Sink) -> Result<ClusterCache, TrainError> {
        let Self { config, reader, encoder_hash, .. } = *self;
        let origin = Origin { version: VERSION, encoder: encoder_hash.into(), settings: settings(config) };
        let mut journal = Journal::open(&folder.with_extension("tmp"), origin)?;

        let total = reader.source.num_scenes();
        let num_scenes = if config.clusters.num_scenes == 0 { total } else { config.clusters.num_scenes.min(total) };
        let total_sets = (config.clusters.num_passes * num_scenes) as u64;
        let started = std::time::Instant::now();
        let done = journal.num_sets();
        sink.event(&Event::StageStarted { stage: Stage::Clusters, done, num_steps: total_sets });
        for set in done..total_sets {
            let (pass, scene) = (set / num_scenes as u64, set as usize % num_scenes);
            let key = reader.source.key(scene);
            match self.cluster_scene(pass, scene) {
                Ok((context, clusters)) => journal.add(key, context, &clusters)?,
                // A scene that does not fit its views is left out; a disk that fails is not a scene.
                Err(TrainError::Data(error)) if !matches!(error, DataError::Io { .. }) => {
                    let reason = error.to_string();
                    sink.event(&Event::Skipped { key: key.into(), reason: reason.clone() });
                    journal.skip(key, &reason)?;
                }
                Err(other) => return Err(other),
            }
            sink.event(&Event::Progress { stage: Stage::Clusters, done: set + 1, total: total_sets });
            if stop.load(Ordering::Relaxed) {
                return Err(TrainError::Interrupted { step: set + 1 });
            }
        }
        sink.event(&Event::StageFinished { stage: Stage::Clusters, elapsed_s: started.elapsed().as_secs_f64() });
        journal.publish(folder, num_scenes)?;
        ClusterCache::open(folder, config, encoder_hash)
    }

    fn cluster_scene(&self, pass: u64, scene: usize) -> Result<(Vec<usize>, SceneClusters), TrainError> {
        let Self { config, reader, encoder, device, .. } = *self;
        let seed = derive_seed(config.seed, "clusters");
        let views = &config.data.views;
        let mut rng = item_rng(seed, pass, scene as u32, 0, "context and count");
        let num_context = views.min_context + below(&mut rng, views.max_context - views.min_context + 1);
        // The gaps that stage 1 ends with.
        let last_step = config.stage1.steps.min(views.warm_up_steps);
        let context = views.draw(reader.source.as_ref(), scene, last_step, num_context, &mut rng)?.context;
        let clip = reader.read(scene, &ViewIndices { context: context.clone(), target: Vec::new() })?;
        let ClustersConfig { grouping, grid, kmeans, .. } = &config.clusters;
        let num_tokens = config.model.num_tokens(num_context, clip.context.height, clip.context.width)?;
        let count = grid[below(&mut rng, grid.len())].of(num_tokens)?;
        let clusters = match grouping {
            Grouping::Kmeans => {
                // Before any norm of the tokens, as in the reference: stage 2 trains that norm, and the clusters stay.
                let lift = encoder.forward(&upload_views(&[&clip.context], device)?);
                let fit = kmeans.fit(lift, count, &[derive_seed(seed, &clip.key)])?;
                fit.clusters.scenes()[0].clone()
            }
            Grouping::Tile => {
                let grid = [clip.context.height, clip.context.width].map(|side| side / config.model.patch_size);
                tile_clusters(num_context, grid, count)?
            }
        };
        Ok((context, clusters))
    }
}

/// An open cluster cache.
#[derive(Debug)]
pub struct ClusterCache {
    folder: PathBuf,
    index: Index,
}

impl ClusterCache {
    /// Opens the cache of a run.
    ///
    /// # Errors
    /// [`TrainError::StaleClusters`] when it was made with another encoder or other settings,
    /// [`TrainError::BadFile`] when it is damaged.
    pub fn open(folder: &Path, config: &Config, encoder: &str) -> Result<Self, TrainError> {
        let path = folder.join("index.json");
        let text = std::fs::read(&path).map_err(TrainError::io("reading the cluster cache", &path))?;
        let index: Index = serde_json::from_slice(&text).map_err(TrainError::bad_file("cluster cache", &path))?;
        let stale = |reason: String| TrainError::StaleClusters { reason, path: folder.into() };
        if index.version != VERSION {
            return Err(stale(format!("it has version {}, this program writes {VERSION}", index.version)));
        }
        if index.encoder != encoder {
            let short = |hash: &str| hash.chars().take(12).collect::<String>();
            let reason =
                format!("its tokens are of encoder {}, the run's is {}", short(&index.encoder), short(encoder));
            return Err(stale(reason));
        }
        if index.settings != settings(config) {
            return Err(stale("its data, sampler or K-means settings are not this run's".into()));
        }
        if let Some(entry) = index.entries.iter().find(|entry| !entry.is_possible()) {
            let Entry { key, num_tokens, num_storage_tokens, .. } = entry;
            let reason = format!("scene {key} has {num_storage_tokens} clusters of {num_tokens} tokens");
            return Err(TrainError::BadFile { what: "cluster cache", reason, path });
        }
        let data = folder.join("clusters.bin");
        let found = std::fs::metadata(&data).map_err(TrainError::io("opening the cluster cache", &data))?.len();
        let expected: u64 = index.entries.iter().map(Entry::num_bytes).sum();
        if found != expected {
            let reason = format!("{found} bytes, {expected} expected");
            return Err(TrainError::BadFile { what: "cluster cache", reason, path: data });
        }
        Ok(Self { folder: folder.into(), index })
    }

    /// What was clustered.
    pub fn entries(&self) -> &[Entry] {
        &self.index.entries
    }

    /// Scenes that could not be clustered.
    pub fn skipped(&self) -> &Ledger {
        &self.index.skipped
    }

    /// Reads the clusters of one entry.
    ///
    /// # Errors
    /// [`TrainError::Io`], and [`clift_model::ModelError::BadClusters`] for indices that contradict each other.
    pub fn read(&self, entry: &Entry) -> Result<SceneClusters, TrainError> {
        let path = self.folder.join("clusters.bin");
        let mut bytes = vec![0; entry.num_bytes() as usize];
        File::open(&path)
            .and_then(|mut file| {
                file.seek(SeekFrom::Start(entry.offset_bytes))?;
                file.read_exact(&mut bytes)
            })
            .map_err(TrainError::io("reading the cluster cache", &path))?;
        let mut values: Vec<u32> =
            bytes.as_chunks::<2>().0.iter().map(|bytes| u32::from(u16::from_le_bytes(*bytes))).collect();
        let centroids = values.split_off(entry.num_tokens);
        Ok(SceneClusters::new(values, centroids)?)
    }
}

/// The settings that decide which clusters come out.
fn settings(config: &Config) -> String {
    let data = &config.data;
    let mut clusters = serde_json::json!(config.clusters);
    if config.clusters.grouping == Grouping::Tile {
        // The former name: with the present one, existing caches would be stale.
        clusters["grouping"] = "patch".into();
    }
    serde_json::json!({
        "seed": config.seed,
        "source": data.source,
        "root": data.root,
        "files": data.files,
        "synthetic": data.synthetic,
        "size": [data.width, data.height],
        "poses": [serde_json::json!(data.pose_rotation), serde_json::json!(data.pose_scale)],
        "exact_principal_point": data.clip_options().exact_principal_point,
        "filters": data.filters,
        "views": data.views,
        "clusters": clusters,
    })
    .to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What a cache says whose only entry has such counts.
    fn opened(num_tokens: usize, num_storage_tokens: usize) -> String {
        let config = Config::default();
        let folder = tempfile::tempdir().expect("a temporary folder");
        let entry = Entry { key: "a".into(), context: vec![0], num_tokens, num_storage_tokens, offset_bytes: 0 };
        let index = Index {
            version: VERSION,
            encoder: "e".into(),
            settings: settings(&config),
            skipped: Ledger::new(1),
            entries: vec![entry],
        };
        std::fs::write(folder.path().join("index.json"), serde_json::to_vec(&index).expect("JSON")).expect("writable");
        std::fs::write(folder.path().join("clusters.bin"), [0, 0, 0, 0]).expect("writable");
        ClusterCache::open(folder.path(), &config, "e").map_or_else(|error| error.to_string(), |_| "opened".into())
    }

    #[test]
    fn counts_that_no_scene_has_are_refused_before_they_are_added_or_allocated() {
        assert_eq!(opened(1, 1), "opened");
        for (num_tokens, num_storage_tokens) in [(usize::MAX, 3), (1 << 62, 1 << 62), (0, 0), (1, 2), (2, 0)] {
            let message = opened(num_tokens, num_storage_tokens);
            let expected = format!("scene a has {num_storage_tokens} clusters of {num_tokens} tokens");
            assert!(message.contains(&expected), "{message}");
        }
    }
}
