//! The largest single tensor of a run. A GPU has a limit for one beside that of its memory: a tensor lies in one buffer,
//! and a shader sees at most `max_storage_buffer_binding_size` of it (below 2 GiB on Vulkan and Direct3D 12).
// B scenes of a part, N tokens, T target views, Q patches of a view, R render tokens, S stored, M members, D width,
// F feed-forward width

use burn::tensor::Device;
use clift_model::adapter::max_tensor_bytes;
use clift_model::attention::MAX_SCORES;

use super::VIEWS_PER_PASS;
use super::sizes::{batch_sizes, num_tokens};
use crate::TrainError;
use crate::config::Config;
use crate::events::Stage;

/// Bytes of an f32; f16 operands are smaller copies of what is there in f32.
const F32: u64 = 4;

/// Above this many values K-means keeps no table of distances.
const MAX_KMEANS_TABLE: u64 = 1 << 26;

/// Maps of the first layers of both VGG networks, at the size of the picture.
const VGG_CHANNELS: u64 = 64;

/// A tensor of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LargestTensor {
    /// The part of the run in which it is largest.
    pub part: Stage,
    /// Which one.
    pub what: &'static str,
    /// Its bytes.
    pub bytes: u64,
}

/// The parts of a run.
pub const PARTS: [Stage; 4] = [Stage::Stage1, Stage::Clusters, Stage::Stage2, Stage::Eval];

/// The largest tensor of one part of a run, at the most views and tokens that it can draw.
///
/// # Errors
/// [`TrainError::BadConfig`] for sizes that cannot be.
pub fn largest_tensor(config: &Config, part: Stage) -> Result<LargestTensor, TrainError> {
    let all = tensors(config, part)?;
    let (what, values) = all.into_iter().max_by_key(|(_, values)| *values).expect("every part has tensors");
    Ok(LargestTensor { part, what, bytes: values * F32 })
}

/// Refuses a run with a tensor that the open device cannot hold, with a setting that fits.
///
/// # Errors
/// [`TrainError::BadConfig`].
pub fn check(config: &Config, device: &Device, parts: &[Stage]) -> Result<(), TrainError> {
    max_tensor_bytes(device).map_or(Ok(()), |limit| check_limit(config, limit, parts))
}

fn check_limit(config: &Config, limit: u64, parts: &[Stage]) -> Result<(), TrainError> {
    for &part in parts {
        let LargestTensor { what, bytes, .. } = largest_tensor(config, part)?;
        if bytes > limit {
            let (key, value, fix) = setting_that_fits(config, part, limit)?;
            let of = if part == Stage::Eval { "the evaluation".into() } else { part.name().to_owned() };
            let fix = format!(
                "{what} of {of} would be one tensor of {bytes} bytes, and {} takes at most {limit} in one: {fix}",
                config.device
            );
            return Err(TrainError::BadConfig { key: key.into(), value, fix });
        }
    }
    Ok(())
}

/// The key to change, its value now, and the change.
fn setting_that_fits(config: &Config, part: Stage, limit: u64) -> Result<(&'static str, String, String), TrainError> {
    let fits = |config: &Config| Ok::<_, TrainError>(largest_tensor(config, part)?.bytes <= limit);
    let mut smaller = config.clone();
    let set_views = |config: &mut Config, count: usize| {
        if part == Stage::Eval {
            config.eval.num_context = count;
            return;
        }
        config.data.views.max_context = count;
        config.data.views.min_context = config.data.views.min_context.min(count);
    };
    let accumulate = match part {
        Stage::Stage1 => Some(("stage1.accumulate", config.stage1.accumulate)),
        Stage::Stage2 => Some(("stage2.accumulate", config.stage2.accumulate)),
        Stage::Clusters | Stage::Eval => None,
    };
    if let Some((key, now)) = accumulate {
        let (batch_size, _) = batch_sizes(config, part);
        for parts in now..=batch_size {
            match part {
                Stage::Stage2 => smaller.stage2.accumulate = parts,
                _ => smaller.stage1.accumulate = parts,
            }
            if fits(&smaller)? {
                return Ok((key, now.to_string(), format!("write {parts}")));
            }
        }
    }
    let (key, now) = match part {
        Stage::Eval => ("eval.num_context", config.eval.num_context),
        _ => ("data.views.max_context", config.data.views.max_context),
    };
    // With one scene at a time, where there are several.
    let also = accumulate.map_or_else(String::new, |(key, _)| format!(" with {key} = {}", batch_sizes(config, part).0));
    for count in (1..now).rev() {
        set_views(&mut smaller, count);
        if fits(&smaller)? {
            return Ok((key, now.to_string(), format!("write {count}{also}, or make pictures smaller")));
        }
    }
    let size = format!("{}, {}", config.data.width, config.data.height);
    Ok(("data.width, data.height", size, "even one view does not fit: make pictures smaller".into()))
}

/// The tensors of a part that can be its largest, with their numbers of values.
fn tensors(config: &Config, part: Stage) -> Result<Vec<(&'static str, u64)>, TrainError> {
    match part {
        Stage::Stage1 | Stage::Stage2 => of_update(config, part),
        Stage::Clusters => of_clusters(config),
        Stage::Eval => of_evaluation(config),
    }
}

/// One network at work on some scenes.
#[expect(clippy::struct_field_names, reason = "they are all numbers of something")]
struct Sizes {
    num_scenes: u64,
    num_tokens: u64,
    num_targets: u64,
    num_patches: u64,
    /// Pixels of a view.
    num_pixels: u64,
}

impl Sizes {
    fn of(config: &Config, num_context: usize, num_scenes: usize, num_targets: usize) -> Result<Self, TrainError> {
        Ok(Self {
            num_scenes: num_scenes as u64,
            num_tokens: num_tokens(config, num_context)? as u64,
            num_targets: num_targets as u64,
            num_patches: num_tokens(config, 1)? as u64,
            num_pixels: (config.data.width * config.data.height) as u64,
        })
    }

    /// Context views of all scenes to tokens.
    fn encoding(&self, config: &Config) -> Vec<(&'static str, u64)> {
        let [dim, hidden] = [config.model.dim, config.model.feed_forward_dim].map(|width| width as u64);
        let rows = self.num_scenes * self.num_tokens;
        vec![
            ("the context pixels with their rays", rows * config.model.context_patch_len() as u64),
            ("the encoder's queries, keys and values", rows * 3 * dim),
            ("the encoder's feed-forward values", rows * hidden),
            ("a chunk of the encoder's scores", scores(config, self.num_scenes, self.num_tokens, self.num_tokens)),
        ]
    }

    /// Target views of all scenes, each from `per_view` tokens of its own, or all from `memory` keys and values.
    fn drawing(&self, config: &Config, keys: u64, groups: u64, projected: u64) -> Vec<(&'static str, u64)> {
        let [dim, hidden] = [config.model.dim, config.model.feed_forward_dim].map(|width| width as u64);
        let Self { num_scenes, num_targets, num_patches, num_pixels, .. } = *self;
        let views = num_scenes * num_targets;
        let rows = views * num_patches;
        let gathered = groups * keys;
        let queries = rows / groups.max(1);
        vec![
            ("the target rays", views * num_pixels * 6),
            ("the renderer's queries, keys and values", rows * 3 * dim),
            ("the renderer's feed-forward values", rows * hidden),
            ("the keys and values of the renderer's tokens", projected.max(gathered) * 2 * dim),
            ("a chunk of the renderer's scores", scores(config, groups, queries, keys)),
        ]
    }

    /// A scene's tokens to stored ones; counts are those with the most centroids and the most members.
    fn condensing(&self, config: &Config, fewest: u64, most: u64) -> Vec<(&'static str, u64)> {
        let [dim, hidden] = [config.model.dim, config.model.feed_forward_dim].map(|width| width as u64);
        let (centroids, members) = (self.num_scenes * most, self.num_scenes * (self.num_tokens - fewest));
        vec![
            ("the keys and values of the condenser's members", members * 2 * dim),
            ("the condenser's queries, keys and values", centroids * 3 * dim),
            ("the condenser's feed-forward values", centroids * hidden),
            ("a chunk of the condenser's scores", scores(config, self.num_scenes, most, most)),
        ]
    }
}

/// Scores that are there at once: a chunk of queries, at least one.
fn scores(config: &Config, groups: u64, queries: u64, keys: u64) -> u64 {
    let of_query = (groups * config.model.num_heads as u64 * keys).max(1);
    of_query * (MAX_SCORES as u64 / of_query).clamp(1, queries.max(1))
}

fn of_update(config: &Config, part: Stage) -> Result<Vec<(&'static str, u64)>, TrainError> {
    let views = &config.data.views;
    let (_, num_scenes) = batch_sizes(config, part);
    let sizes = Sizes::of(config, views.max_context, num_scenes, views.num_targets)?;
    let mut all = sizes.encoding(config);
    let num_views = sizes.num_scenes * sizes.num_targets;
    let rows = sizes.num_scenes * sizes.num_tokens;
    if part == Stage::Stage2 {
        let (fewest, most) = counts(config, sizes.num_tokens as usize)?;
        all.extend(sizes.condensing(config, fewest, most));
        all.extend(sizes.drawing(config, most, sizes.num_scenes, sizes.num_scenes * most));
    } else {
        let [low, high] = config.stage1.keep_tokens;
        let kept = ((sizes.num_tokens as f64 * high) as u64).clamp(1, sizes.num_tokens);
        // Shares are drawn: with all tokens views share them, with all but one every view has a set of its own.
        let own = if low < 1.0 { kept.min((sizes.num_tokens - 1).max(1)) } else { 0 };
        if own > 0 {
            all.extend(sizes.drawing(config, own, num_views, rows.min(num_views * own)));
        }
        if kept == sizes.num_tokens {
            all.extend(sizes.drawing(config, kept, sizes.num_scenes, rows));
        }
    }
    if config.loss.perceptual_weight > 0.0 {
        all.push(("the first maps of the perceptual loss", num_views * sizes.num_pixels * VGG_CHANNELS));
    }
    Ok(all)
}

/// Fewest and most tokens that stage 2 stores.
fn counts(config: &Config, num_tokens: usize) -> Result<(u64, u64), TrainError> {
    let counts = config.clusters.grid.iter().map(|count| count.of(num_tokens)).collect::<Result<Vec<_>, _>>()?;
    let (fewest, most) = (counts.iter().min().copied(), counts.iter().max().copied());
    Ok((fewest.unwrap_or(num_tokens) as u64, most.unwrap_or(num_tokens) as u64))
}

fn kmeans(num_tokens: u64, most: u64) -> (&'static str, u64) {
    let table = num_tokens * num_tokens;
    ("the distances of K-means", if table <= MAX_KMEANS_TABLE { table } else { num_tokens * most })
}

fn of_clusters(config: &Config) -> Result<Vec<(&'static str, u64)>, TrainError> {
    let sizes = Sizes::of(config, config.data.views.max_context, 1, 0)?;
    let mut all = sizes.encoding(config);
    all.push(kmeans(sizes.num_tokens, counts(config, sizes.num_tokens as usize)?.1));
    Ok(all)
}

fn of_evaluation(config: &Config) -> Result<Vec<(&'static str, u64)>, TrainError> {
    let eval = &config.eval;
    let sizes = Sizes::of(config, eval.num_context, 1, eval.num_targets.clamp(1, VIEWS_PER_PASS))?;
    let counts = eval.storage.iter().map(|count| count.of(sizes.num_tokens as usize)).collect::<Result<Vec<_>, _>>();
    // Of an index, which may have fewer contexts or more, nothing is known here.
    let counts = counts.unwrap_or_else(|_| vec![sizes.num_tokens as usize]);
    let fewest = counts.iter().min().map_or(sizes.num_tokens, |&count| count as u64);
    let most = counts.iter().max().map_or(sizes.num_tokens, |&count| count as u64);
    let mut all = sizes.encoding(config);
    all.push(kmeans(sizes.num_tokens, most));
    all.extend(sizes.condensing(config, fewest, most));
    all.extend(sizes.drawing(config, most, 1, most));
    if eval.lpips_path().is_some() {
        all.push(("the first maps of LPIPS", sizes.num_targets * sizes.num_pixels * VGG_CHANNELS));
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use clift_model::TokenCount;

    use super::*;

    /// The paper's network on six contexts of 256 x 256 and six targets, N = 6,144, T Q = 6,144.
    fn paper() -> Config {
        let mut config = Config { run_dir: "run".into(), ..Config::default() };
        (config.data.views.min_context, config.data.views.max_context, config.data.views.num_targets) = (4, 6, 6);
        (config.data.synthetic.width, config.data.synthetic.height) = (256, 256);
        config
    }

    fn largest(config: &Config, part: Stage) -> (&'static str, u64) {
        let LargestTensor { what, bytes, .. } = largest_tensor(config, part).expect("valid");
        (what, bytes)
    }

    #[test]
    fn the_papers_batch_is_largest_where_views_have_tokens_of_their_own() {
        let mut config = paper();
        config.stage1.accumulate = 16;
        // 4 scenes x 6 views x 6,143 tokens x 2 x 768 values.
        let own = ("the keys and values of the renderer's tokens", 4 * 6 * 6143 * 2 * 768 * 4);
        assert_eq!(largest(&config, Stage::Stage1), own);
        // With all tokens in every step views share them: 4 x 6,144 x 3 x 768 of the encoder are more.
        config.stage1.keep_tokens = [1.0, 1.0];
        let packed = 4 * 6144 * 3 * 768 * 4;
        assert_eq!(largest(&config, Stage::Stage1).1, packed);
        config.loss.perceptual_weight = 0.5;
        let maps = ("the first maps of the perceptual loss", 4 * 6 * 65_536 * 64 * 4);
        assert_eq!(largest(&config, Stage::Stage1), maps);
    }

    #[test]
    fn counts_of_stage_two_the_clusters_and_the_evaluation() {
        let mut config = paper();
        config.stage2.accumulate = 80;
        config.clusters.grid = vec![TokenCount::Share(0.25), TokenCount::Share(1.0)];
        // One scene: 6,144 tokens x 3 x 768 and the same of 6 x 1,024 patches; scores of 8 heads in chunks of 2^24.
        let scores = 8 * 6144 * (MAX_SCORES as u64 / (8 * 6144)) * 4;
        assert_eq!(largest(&config, Stage::Stage2).1, scores);
        // A table of 6,144^2 distances.
        assert_eq!(largest(&config, Stage::Clusters), ("the distances of K-means", 6144 * 6144 * 4));
        config.data.views.max_context = 9;
        // 9,216^2 are more than a table may have: distances to 9,216 clusters.
        assert_eq!(largest(&config, Stage::Clusters), ("the distances of K-means", 9216 * 9216 * 4));
        config.eval.num_context = 1;
        config.eval.num_targets = 100;
        // Eight views at a time: 8 x 1,024 x 3 x 768.
        assert_eq!(largest(&config, Stage::Eval).1, 8 * 1024 * 3 * 768 * 4);
    }

    #[test]
    fn a_run_that_does_not_fit_is_refused_with_the_micro_batch_that_does() {
        let config = paper();
        let limit = (1 << 31) - 4;
        let message = check_limit(&config, limit, &PARTS).unwrap_err().to_string();
        // 64 scenes x 6 views at once; of 9 scenes it is 2.04e9 bytes, so 8 parts fit.
        let bytes = 64_u64 * 6 * 6143 * 2 * 768 * 4;
        let expected = format!(
            "`stage1.accumulate` = 1: the keys and values of the renderer's tokens of stage1 would be one tensor of \
             {bytes} bytes, and flex takes at most {limit} in one: write 8"
        );
        assert_eq!(message, expected);
        let mut fitting = config.clone();
        fitting.stage1.accumulate = 8;
        check_limit(&fitting, limit, &[Stage::Stage1]).expect("what the message says");
        fitting.stage1.accumulate = 7;
        assert!(check_limit(&fitting, limit, &[Stage::Stage1]).is_err(), "and no less");
    }

    #[test]
    fn where_one_scene_is_too_much_fewer_views_or_smaller_pictures_are_named() {
        let mut config = paper();
        config.stage1.accumulate = 64;
        // 6 x 5,119 x 2 x 768 values of five contexts.
        let limit = 6 * 5119 * 2 * 768 * 4;
        let message = check_limit(&config, limit, &[Stage::Stage1]).unwrap_err().to_string();
        assert!(message.starts_with("`data.views.max_context` = 6:"), "{message}");
        assert!(message.ends_with("write 5 with stage1.accumulate = 64, or make pictures smaller"), "{message}");
        let message = check_limit(&config, 1000, &[Stage::Eval]).unwrap_err().to_string();
        assert!(message.starts_with("`data.width, data.height` = 256, 256:"), "{message}");
        check(&config, &Device::flex(), &PARTS).expect("memory alone is a CPU's limit");
    }
}
