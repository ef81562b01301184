//! `clift bench data`: clips read per second, in order and at random.

use std::sync::Arc;
use std::time::Instant;

use clift_core::{BadConfig, item_rng, median, p95, sample_distinct, uniform_below};
use clift_data::{ClipOptions, ClipReader, DataError, Prefetcher, SceneSource, ViewIndices};
use serde::Serialize;

const NUM_PREFETCH: usize = 8;

/// Clips to read.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ThroughputOptions {
    /// Size and frame of the views.
    pub clip: ClipOptions,
    /// Context and target frames of a clip, distinct if the scene has enough.
    pub num_views: [usize; 2],
    /// Clips of each measurement.
    pub num_clips: usize,
    /// Threads of the sequential measurement.
    pub num_threads: usize,
    /// Seed of frames and of random scenes.
    pub seed: u64,
}

/// A clip that was read.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ReadClip {
    /// Key of the scene.
    pub key: String,
    /// Context frames.
    pub context: Vec<usize>,
    /// Target frames.
    pub target: Vec<usize>,
}

/// Measured times, with the clips, so that another program can read the same ones.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Throughput {
    /// Columns and rows of a view.
    pub size: [usize; 2],
    /// Threads of the sequential measurement.
    pub num_threads: usize,
    /// Clips per second in the order of the source, prepared ahead by the threads.
    pub sequential_clips_per_s: f64,
    /// Median latency in seconds of a random clip, read alone on one thread.
    pub random_median_s: f64,
    /// 95th percentile of this latency.
    pub random_p95_s: f64,
    /// Random clips per second on one thread.
    pub random_clips_per_s: f64,
    /// Clips read in order.
    pub sequential: Vec<ReadClip>,
    /// Clips read at random.
    pub random: Vec<ReadClip>,
}

/// Times reading clips in order and then at random.
///
/// # Errors
/// [`DataError::BadConfig`] for no clips, views or scenes, and the error of the first unreadable clip.
pub fn measure_reading(source: &Arc<dyn SceneSource>, options: &ThroughputOptions) -> Result<Throughput, DataError> {
    let ThroughputOptions { clip, num_clips, num_threads, seed, .. } = *options;
    for (key, value) in
        [("num_clips", num_clips), ("num_context", options.num_views[0]), ("num_scenes", source.num_scenes())]
    {
        if value == 0 {
            return Err(BadConfig::new(key, 0, "use at least 1").into());
        }
    }
    let reader = ClipReader { source: Arc::clone(source), options: clip };
    let views = |scene: usize, index: usize| {
        let num_frames = source.num_frames(scene)?;
        Ok((
            scene,
            sample_frames(num_frames, options.num_views, &mut item_rng(seed, index as u64, 0, 0, "bench views")),
        ))
    };
    let at_random =
        |index: usize| uniform_below(&mut item_rng(seed, index as u64, 0, 0, "bench scene"), source.num_scenes());
    let in_order = (0..num_clips).map(|index| views(index % source.num_scenes(), index));
    let in_order: Vec<(usize, ViewIndices)> = in_order.collect::<Result<_, DataError>>()?;
    let random = (0..num_clips).map(|index| views(at_random(index), num_clips + index));
    let random: Vec<(usize, ViewIndices)> = random.collect::<Result<_, DataError>>()?;
    let list = in_order.clone();
    let started = Instant::now();
    let sequential_reader = reader.clone();
    let read = move |step: u64| {
        let (scene, views) = &list[step as usize];
        sequential_reader.read(*scene, views)
    };
    for clip in Prefetcher::<_, DataError>::new(read, 0, num_clips as u64, num_threads, NUM_PREFETCH) {
        clip?;
    }
    let sequential_s = started.elapsed().as_secs_f64();

    let mut latencies = Vec::with_capacity(num_clips);
    for (scene, views) in &random {
        let started = Instant::now();
        reader.read(*scene, views)?;
        latencies.push(started.elapsed().as_secs_f64());
    }
    let random_s: f64 = latencies.iter().sum();
    let named = |clips: Vec<(usize, ViewIndices)>| {
        let name = |(scene, ViewIndices { context, target }): (usize, ViewIndices)| ReadClip {
            key: source.key(scene).to_owned(),
            context,
            target,
        };
        clips.into_iter().map(name).collect()
    };
    Ok(Throughput {
        size: [clip.width, clip.height],
        num_threads,
        sequential_clips_per_s: num_clips as f64 / sequential_s,
        random_median_s: median(&latencies),
        random_p95_s: p95(&latencies),
        random_clips_per_s: num_clips as f64 / random_s,
        sequential: named(in_order),
        random: named(random),
    })
}

/// Samples frames of a scene, distinct if the scene has enough, and spreads the targets among the contexts.
fn sample_frames(num_frames: usize, [num_context, num_targets]: [usize; 2], rng: &mut impl rand::Rng) -> ViewIndices {
    let num_views = num_context + num_targets;
    let mut frames = sample_distinct(rng, num_frames, num_views.min(num_frames));
    while frames.len() < num_views && num_frames > 0 {
        frames.push(uniform_below(rng, num_frames));
    }
    let is_target =
        |index: usize| index * num_targets / num_views.max(1) != (index + 1) * num_targets / num_views.max(1);
    let (mut context, mut target) = (Vec::new(), Vec::new());
    for (index, frame) in frames.into_iter().enumerate() {
        if is_target(index) { &mut target } else { &mut context }.push(frame);
    }
    ViewIndices { context, target }
}

#[cfg(test)]
mod tests {
    use clift_data::{SyntheticConfig, SyntheticSource};

    use super::*;

    #[test]
    fn clips_are_read_in_order_and_at_random() {
        let config = SyntheticConfig { num_scenes: 3, num_frames: 12, width: 16, height: 16, ..Default::default() };
        let source: Arc<dyn SceneSource> = Arc::new(SyntheticSource::new(config).unwrap());
        let clip = ClipOptions { width: 8, height: 8, ..ClipOptions::default() };
        let options = ThroughputOptions { clip, num_views: [4, 3], num_clips: 7, num_threads: 2, seed: 1 };
        let measured = measure_reading(&source, &options).unwrap();
        assert_eq!((measured.sequential.len(), measured.random.len()), (7, 7));
        let keys: Vec<&str> = measured.sequential.iter().map(|clip| clip.key.as_str()).collect();
        assert_eq!(keys[..4], [source.key(0), source.key(1), source.key(2), source.key(0)]);
        assert!(measured.sequential.iter().all(|clip| clip.context.len() == 4 && clip.target.len() == 3));
        assert!(measured.sequential_clips_per_s > 0.0 && measured.random_median_s <= measured.random_p95_s);
        assert_eq!(measured.random, measure_reading(&source, &options).unwrap().random);
        assert!(measure_reading(&source, &ThroughputOptions { num_clips: 0, ..options }).is_err());
    }

    #[test]
    fn sampled_frames_are_distinct_in_long_scenes() {
        let mut rng = item_rng(1, 0, 0, 0, "test");
        let ViewIndices { context, target } = sample_frames(20, [4, 6], &mut rng);
        let mut all = [context, target].concat();
        all.sort_unstable();
        all.dedup();
        assert_eq!(all.len(), 10);
        let few = sample_frames(3, [4, 6], &mut rng);
        assert!((few.context.len(), few.target.len()) == (4, 6) && few.context.iter().all(|frame| *frame < 3));
    }
}
