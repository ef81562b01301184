//! A capture to a scene: contexts, tokens, clusters, condenser.
// N encoder tokens, S stored tokens, D width

use burn::tensor::Tensor;
use clift_data::order::derive_seed;
use clift_data::{ClipReader, Pose, SceneFrame, ViewIndices, spread_along_path};
use clift_eval::{TokenCount, upload_views, view_cameras};
use clift_model::{Clusters, Grouping, Scene, TokenKind, WorldFrame, total_variance, weights};

use crate::TrainError;
use crate::config::Config;
use crate::trained::Trained;

/// How many tokens a scene is given.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Budget {
    /// So many.
    Tokens(TokenCount),
    /// The smallest count of the grid that leaves at most this share of the tokens' variance within clusters: a plain
    /// wall costs less than a bookshelf.
    MaxError(f64),
}

/// What is to be encoded.
#[derive(Clone, Debug, PartialEq)]
pub struct EncodeOptions {
    /// Frames the encoder sees; `None`: as many as in training, spread along the path.
    pub context: Option<Vec<usize>>,
    /// How many tokens are kept.
    pub budget: Budget,
    /// The model as the user typed it: noted in the scene.
    pub model_path: String,
}

/// A scene, and what it took.
#[derive(Clone, Debug)]
pub struct Encoded {
    /// The scene.
    pub scene: Scene,
    /// Tokens before clustering.
    pub num_lift_tokens: usize,
    /// Counts that were tried, each with the share of the variance that it leaves within clusters. The last is kept.
    pub tried: Vec<(usize, f64)>,
}

impl Trained {
    /// Encodes a scene of `reader`. Clusters are those of `clift eval` for the same contexts and count.
    ///
    /// # Errors
    /// [`TrainError::BadConfig`] for contexts, counts or an error that cannot be had, and whatever reading the capture
    /// gives.
    pub fn encode(
        &self,
        config: &Config,
        reader: &ClipReader,
        scene: usize,
        options: &EncodeOptions,
    ) -> Result<Encoded, TrainError> {
        if config.clusters.grouping != Grouping::Kmeans {
            let fix = "scenes are of K-means tokens: encode with a run whose clusters.grouping is \"kmeans\"".into();
            return Err(TrainError::BadConfig { key: "clusters.grouping".into(), value: "\"patch\"".into(), fix });
        }
        let key = reader.source.key(scene);
        let poses: Vec<Pose> = reader.source.cameras(scene)?.iter().map(|camera| camera.c2w).collect();
        let frames = context_frames(&poses, options.context.as_deref(), config.data.views.max_context)?;
        let context_poses: Vec<Pose> = frames.iter().map(|&frame| poses[frame]).collect();
        let views = ViewIndices { context: frames, target: Vec::new() };
        let clip = reader.read(scene, &views)?;
        let data = &config.data;
        let frame = SceneFrame::find(key, &context_poses, &[], data.pose_rotation, data.pose_scale)?;

        let lift = self.encoder.forward(&upload_views(&[&clip.context], &self.device)?); // [1, N, D]
        let lift = self.lift_norm.forward(lift);
        let [_, num_lift_tokens, dim] = lift.dims();
        let seed = derive_seed(derive_seed(config.seed, "eval"), key);
        let (clusters, tried) = cluster(config, &lift, options.budget, seed)?;
        let index = clusters.upload(&self.device);
        let (kind, tokens) = match &self.condenser {
            Some(condenser) => (TokenKind::Clift, condenser.forward(lift, &index)),
            None => (TokenKind::Kmeans, index.gather_centroids(lift)),
        };
        let tokens = tokens.into_data().convert::<f32>();
        let tokens = tokens.try_to_vec::<f32>().map_err(|error| TrainError::Tensor { reason: format!("{error:?}") })?;
        let token_ids = clusters.scenes()[0].centroid_index().to_vec();
        debug_assert_eq!(tokens.len(), token_ids.len() * dim, "a row per centroid");
        let scene = Scene {
            key: key.into(),
            kind,
            model: config.model.clone(),
            renderer_hash: weights::renderer_hash(&self.renderer, &config.model),
            model_path: options.model_path.clone(),
            height: data.height,
            width: data.width,
            context: view_cameras(&clip.context),
            context_frames: views.context.iter().map(|&frame| frame as u32).collect(),
            world: WorldFrame { mean_c2w: frame.mean_c2w.to_matrix_f64(), scale: frame.scale },
            token_ids,
            tokens,
        };
        Ok(Encoded { scene, num_lift_tokens, tried })
    }
}

/// The frames asked for, or as many as in training, spread along the path.
fn context_frames(poses: &[Pose], asked: Option<&[usize]>, num_views: usize) -> Result<Vec<usize>, TrainError> {
    let num_frames = poses.len();
    let bad = |value: String, fix: String| TrainError::BadConfig { key: "--context".into(), value, fix };
    let Some(asked) = asked else {
        return spread_along_path(poses, num_views.min(num_frames)).ok_or_else(|| {
            bad(num_views.to_string(), format!("the scene has {num_frames} frames; name frames to use"))
        });
    };
    let list = asked.iter().map(ToString::to_string).collect::<Vec<_>>().join(",");
    let mut sorted = asked.to_vec();
    sorted.sort_unstable();
    sorted.dedup();
    if asked.len() < 2 || sorted.len() < asked.len() {
        return Err(bad(list, "write at least two frames, each once".into()));
    }
    if let Some(frame) = asked.iter().find(|frame| **frame >= num_frames) {
        let last = num_frames.saturating_sub(1);
        return Err(bad(list, format!("there is no frame {frame}; the scene has frames 0 to {last}")));
    }
    Ok(asked.to_vec())
}

/// Clusters for the budget, and every count that was tried with its error.
fn cluster(
    config: &Config,
    lift: &Tensor<3>,
    budget: Budget,
    seed: u64,
) -> Result<(Clusters, Vec<(usize, f64)>), TrainError> {
    let [_, num_tokens, _] = lift.dims();
    let (counts, limit) = match budget {
        Budget::Tokens(count) => (vec![count.of(num_tokens)?], f64::INFINITY),
        Budget::MaxError(limit) => {
            // Fewer views than in training have fewer tokens than the largest counts may ask for.
            let mut counts: Vec<_> =
                config.clusters.grid.iter().filter_map(|count| count.of(num_tokens).ok()).collect();
            if counts.is_empty() {
                counts.push(num_tokens);
            }
            counts.sort_unstable();
            counts.dedup();
            (counts, limit)
        }
    };
    let variance = total_variance(lift)?[0];
    let mut tried = Vec::new();
    for count in counts {
        let fit = config.clusters.kmeans.fit(lift.clone(), count, &[seed])?;
        let error = fit.error(0, variance);
        tried.push((count, error));
        if error <= limit {
            return Ok((fit.clusters, tried));
        }
    }
    let (count, error) = tried.last().copied().unwrap_or_default();
    let fix = format!(
        "{count} tokens, the most of the run's clusters.grid, leave {error:.4}; write at least that, or --storage 1.0"
    );
    Err(TrainError::BadConfig { key: "--max-error".into(), value: limit.to_string(), fix })
}

#[cfg(test)]
mod tests {
    use burn::tensor::{Device, TensorData};

    use super::*;

    /// Tokens of two values: `num_kinds` places, far apart, with a little noise.
    fn tokens(num_tokens: usize, num_kinds: usize) -> Tensor<3> {
        let value = |i: usize| [(i % num_kinds) as f32 * 10.0, ((i * 7919) % 101) as f32 * 1e-3];
        let values: Vec<f32> = (0..num_tokens).flat_map(value).collect();
        Tensor::from_data(TensorData::new(values, [1, num_tokens, 2]), &Device::flex())
    }

    fn config(grid: &[TokenCount]) -> Config {
        let mut config = Config::default();
        config.clusters.grid = grid.to_vec();
        config
    }

    const GRID: [TokenCount; 4] =
        [TokenCount::Share(0.5), TokenCount::Count(2), TokenCount::Count(8), TokenCount::Share(1.0)];

    #[test]
    fn an_error_takes_the_smallest_count_that_meets_it_so_that_a_plain_scene_costs_less() {
        let count = |num_kinds, limit| {
            let (clusters, tried) =
                cluster(&config(&GRID), &tokens(64, num_kinds), Budget::MaxError(limit), 1).unwrap();
            assert_eq!(clusters.scenes()[0].centroid_index().len(), tried.last().unwrap().0);
            assert!(tried.windows(2).all(|pair| pair[0].0 < pair[1].0 && pair[0].1 > limit), "{tried:?}");
            tried.last().unwrap().0
        };
        assert_eq!((count(2, 0.01), count(8, 0.01), count(64, 0.0)), (2, 8, 64));
        // Two means of eight places in a row leave a fourth of the spread of the places.
        assert_eq!(count(8, 0.3), 2);
    }

    #[test]
    fn the_error_is_the_variance_within_clusters_over_the_total() {
        let lift = tokens(64, 2);
        let values: Vec<f32> = lift.to_data().try_to_vec().unwrap();
        let rows: Vec<[f64; 2]> = values.chunks(2).map(|row| [f64::from(row[0]), f64::from(row[1])]).collect();
        let spread = |rows: &[[f64; 2]]| {
            let mean = [0, 1].map(|i| rows.iter().map(|row| row[i]).sum::<f64>() / rows.len() as f64);
            rows.iter().flat_map(|row| [row[0] - mean[0], row[1] - mean[1]]).map(|d| d * d).sum::<f64>()
        };
        let (even, odd): (Vec<_>, Vec<_>) = rows.iter().partition(|row| row[0] == 0.0);
        let expected = (spread(&even) + spread(&odd)) / spread(&rows);
        let (_, tried) = cluster(&config(&GRID), &lift, Budget::Tokens(TokenCount::Count(2)), 1).unwrap();
        assert!((tried[0].1 / expected - 1.0).abs() < 1e-3, "{tried:?} against {expected}"); // f32
    }

    #[test]
    fn an_error_that_no_count_meets_says_what_the_largest_leaves() {
        let grid = [TokenCount::Count(2), TokenCount::Count(4)];
        let message =
            cluster(&config(&grid), &tokens(64, 16), Budget::MaxError(1e-9), 1).map(|_| ()).unwrap_err().to_string();
        assert!(message.starts_with("`--max-error` = 0.000000001: 4 tokens, the most of the run's"), "{message}");
    }

    #[test]
    fn counts_that_a_scene_of_few_views_does_not_have_are_left_out() {
        let kept = |grid: &[TokenCount]| {
            cluster(&config(grid), &tokens(6, 3), Budget::MaxError(0.5), 1).unwrap().1.last().unwrap().0
        };
        assert_eq!(kept(&[TokenCount::Count(100), TokenCount::Count(3)]), 3);
        assert_eq!(kept(&[TokenCount::Count(100)]), 6, "all there are");
    }

    #[test]
    fn a_scene_of_equal_tokens_has_no_error() {
        let lift = Tensor::<3>::ones([1, 8, 2], &Device::flex());
        let (_, tried) = cluster(&config(&GRID[1..2]), &lift, Budget::MaxError(0.0), 1).unwrap();
        assert_eq!(tried, [(2, 0.0)]);
    }

    #[test]
    fn contexts_are_those_asked_for_or_spread_and_wrong_ones_are_named() {
        let at = |x: f64| Pose { translation: [x, 0.0, 0.0].into(), ..Pose::IDENTITY };
        let poses: Vec<Pose> = (0..10).map(f64::from).map(at).collect();
        assert_eq!(context_frames(&poses, None, 4).unwrap(), [0, 3, 6, 9]);
        assert_eq!(context_frames(&poses[..3], None, 4).unwrap(), [0, 1, 2]);
        assert_eq!(context_frames(&poses, Some(&[7, 2]), 4).unwrap(), [7, 2]);
        let message = |asked: &[usize]| context_frames(&poses, Some(asked), 4).unwrap_err().to_string();
        assert_eq!(message(&[0, 10]), "`--context` = 0,10: there is no frame 10; the scene has frames 0 to 9");
        assert_eq!(message(&[3, 3]), "`--context` = 3,3: write at least two frames, each once");
        assert_eq!(message(&[3]), "`--context` = 3: write at least two frames, each once");
    }
}
