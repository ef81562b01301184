//! Batches of stage 2: clips with cached clusters.

use std::collections::BTreeMap;

use clift_core::{derive_seed, item_rng, step_rng, uniform_below};
use clift_data::{Clip, ClipReader, SkippedScene, ViewIndices, ViewSampler};
use clift_model::SceneClusters;

use crate::cluster_cache::cache::{CacheEntry, ClusterCache};
use crate::config::config::Config;
use crate::distributed::parts::BatchParts;
use crate::error::TrainError;
use crate::step::batch::{BatchTokens, StageBatch};

/// Attempts per slot, repeated entries included, before the batch fails.
const MAX_ATTEMPTS: u32 = 16;

/// Maker of the batches of stage 2, a pure function of (seed, step) and the cluster cache.
pub struct Stage2Batches {
    reader: ClipReader,
    cache: ClusterCache,
    /// Entries with equal numbers of tokens and of clusters, which a batch needs.
    groups: Vec<Vec<usize>>,
    parts: BatchParts,
    views: ViewSampler,
    seed: u64,
}

impl Stage2Batches {
    /// Makes batches of the slots that `parts` gives to this rank.
    pub fn new(
        config: &Config,
        reader: &ClipReader,
        cache: ClusterCache,
        parts: BatchParts,
    ) -> Result<Self, TrainError> {
        let mut groups: BTreeMap<_, Vec<usize>> = BTreeMap::new();
        for (i, entry) in cache.entries().iter().enumerate() {
            groups.entry((entry.num_tokens, entry.num_storage_tokens)).or_default().push(i);
        }
        if groups.is_empty() {
            return Err(TrainError::NoScenes { reason: "the cluster cache is empty".into() });
        }
        Ok(Self {
            reader: reader.clone(),
            cache,
            groups: groups.into_values().collect(),
            parts,
            views: config.data.views.clone(),
            seed: derive_seed(config.seed, "stage2"),
        })
    }

    /// Makes the batch of `step`, counted from 0: samples a group, then its entries.
    pub fn batch(&self, step: u64) -> Result<StageBatch, TrainError> {
        let group = self.sample_group(step);
        let (mut clips, mut clusters, mut skipped) = (Vec::new(), Vec::new(), Vec::new());
        for slot in self.parts.slots() {
            let mut of_slot = Vec::new();
            let (clip, scene) = self.fill_slot(step, slot, group, &mut of_slot)?;
            skipped.extend(of_slot.into_iter().map(|skip| (slot, skip)));
            clips.push(clip);
            clusters.push(scene);
        }
        Ok(StageBatch { step, clips, tokens: BatchTokens::Clusters(clusters), skipped })
    }

    /// Samples a group in proportion to its size, so that all entries are equally likely.
    fn sample_group(&self, step: u64) -> &[usize] {
        let total = self.groups.iter().map(Vec::len).sum();
        let index = uniform_below(&mut step_rng(self.seed, step, "token count"), total);
        let mut of_entries = self.groups.iter().flat_map(|group| std::iter::repeat_n(group, group.len()));
        of_entries.nth(index).expect("an index of an entry")
    }

    fn fill_slot(
        &self,
        step: u64,
        slot: usize,
        group: &[usize],
        skipped: &mut Vec<SkippedScene>,
    ) -> Result<(Clip, SceneClusters), TrainError> {
        for attempt in 0..MAX_ATTEMPTS {
            // The entry is the first value of the stream of an attempt, the targets are the following ones.
            let mut rng = item_rng(self.seed, step, slot as u32, attempt, "entry and targets");
            let entry = &self.cache.entries()[group[uniform_below(&mut rng, group.len())]];
            match self.read(entry, &mut rng) {
                Ok(item) => return Ok(item),
                Err(error) => skipped.push(SkippedScene { key: entry.key.clone(), reason: error.to_string() }),
            }
        }
        let last = skipped.last().map(|SkippedScene { key, reason }| format!("{key}: {reason}")).unwrap_or_default();
        Err(TrainError::NoScenes { reason: format!("slot {slot} of step {step}, {MAX_ATTEMPTS} tries; {last}") })
    }

    fn read(&self, entry: &CacheEntry, rng: &mut impl rand::Rng) -> Result<(Clip, SceneClusters), TrainError> {
        let source = &self.reader.source;
        let scene = source
            .find(&entry.key)
            .ok_or_else(|| TrainError::NoScenes { reason: "the scene is not in the data".into() })?;
        let target = self.views.sample_targets(source.as_ref(), scene, &entry.context, rng)?;
        let clip = self.reader.read(scene, &ViewIndices { context: entry.context.clone(), target })?;
        Ok((clip, self.cache.read(entry)?))
    }
}
