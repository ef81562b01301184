//! The stored tokens of a scene, by method, and the model that renders them.
// N encoder tokens, S stored tokens, R rendered tokens, D width

use std::cell::RefCell;
use std::collections::BTreeMap;

use clift_core::{Pose, PoseNormalization, derive_seed, item_rng};
use clift_data::Clip;
use clift_model::{Clusters, Grouping, Tokens, TrainedModel};
use clift_scene::{ContextGroup, Scene, TokenCodec, TokenCoding, TokenFormat, scene_file_bytes};
use rand::Rng;
use rand::seq::SliceRandom;

use crate::config::method::Method;
use crate::error::EvalError;
use crate::sweep::eval_models::EvalModels;
use crate::sweep::sweep::Sweep;

/// The encoder's tokens of a scene, and their groups, each computed for the first method that needs them.
pub(crate) struct Lift<'a> {
    /// `[1, N, D]`
    pub tokens: Tokens,
    pub seed: u64,
    sweep: &'a Sweep,
    /// Number of context views, and rows and columns of patches of a view.
    views: (usize, [usize; 2]),
    /// Groups by grouping and number.
    groups: RefCell<BTreeMap<(usize, usize), Clusters>>,
}

impl<'a> Lift<'a> {
    pub fn new(tokens: Tokens, sweep: &'a Sweep, clip: &Clip) -> Self {
        let grid = [clip.context.height, clip.context.width].map(|side| side / sweep.model.patch_size);
        let (seed, views) = (derive_seed(sweep.seed, &clip.key), (clip.context.num_views(), grid));
        Self { tokens, seed, sweep, views, groups: RefCell::default() }
    }

    fn groups(&self, grouping: Grouping, count: usize) -> Result<Clusters, EvalError> {
        let key = (grouping as usize, count);
        if let Some(groups) = self.groups.borrow().get(&key) {
            return Ok(groups.clone());
        }
        let tokens = || self.tokens.values.clone();
        let groups = grouping.group(count, self.views, (&self.sweep.kmeans, self.seed), tokens)?;
        let groups = Clusters::new(vec![groups])?;
        self.groups.borrow_mut().insert(key, groups.clone());
        Ok(groups)
    }
}

pub(crate) struct CompressedTokens<'a> {
    /// `[1, S, D]`
    pub tokens: Tokens,
    /// The patch of the context views of every token, `[S]`; empty if all are rendered.
    pub ids: Vec<u32>,
    pub model: &'a TrainedModel,
    /// Size of the scene file; `None` for random subsets, which have no file.
    pub file_bytes: Option<u64>,
}

impl<'a> CompressedTokens<'a> {
    /// Makes the tokens of a method, rounded like the tokens of a scene file. Random subsets have no file and stay f32.
    pub fn new(
        method: Method,
        models: &'a EvalModels,
        (lift, count): (&Lift, usize),
        coding: TokenCoding,
        (clip, model_path): (&Clip, &str),
    ) -> Result<Self, EvalError> {
        let model = models.for_method(method).ok_or_else(|| EvalError::NoModel { method: method.name().into() })?;
        let Some(grouping) = method.grouping() else {
            let ids = random_subset(lift.tokens.dims()[1], count, item_rng(lift.seed, 0, 0, 0, "random subset"));
            return Ok(Self { tokens: lift.tokens.select(&ids), ids, model, file_bytes: None });
        };
        let clusters = lift.groups(grouping, count)?;
        let uploaded = clusters.upload(&model.device);
        let tokens = if method.is_condensed() {
            model.network.compress(lift.tokens.clone(), &uploaded)
        } else {
            lift.tokens.centroids(&uploaded)
        };
        let ids = clusters.scenes()[0].centroid_index().to_vec();
        let (num_tokens, num_views) = (ids.len(), clip.context.num_views());
        let (tokens, bytes) = match coding {
            TokenCoding::Plain(format) => {
                let bytes = scene_file_bytes(&model.config, num_tokens, (num_views, 1, num_views), format);
                (rounded(tokens, format)?, bytes)
            }
            TokenCoding::Coded(loss) => {
                let codec =
                    models.codec.as_ref().ok_or_else(|| EvalError::NoModel { method: "coded tokens".into() })?;
                let share = num_tokens as f64 / lift.tokens.dims()[1] as f64;
                let step = codec.rates.step_for_loss(share, loss.db()) as f32;
                let scene = scene_of(clip, codec, &ids, tokens.to_host()?, model_path);
                let bytes = scene.coded_bytes(codec, step)?.len() as u64;
                (tokens.with_host_values(scene.rounded_tokens(codec, step)?), bytes)
            }
        };
        Ok(Self { tokens, ids, model, file_bytes: Some(bytes) })
    }

    /// Returns all tokens of a network without clusters, rounded as a scene file rounds them.
    pub fn whole(
        model: &'a TrainedModel,
        tokens: Tokens,
        format: TokenFormat,
        num_views: usize,
    ) -> Result<Self, EvalError> {
        let bytes = scene_file_bytes(&model.config, tokens.dims()[1], (num_views, 1, num_views), format);
        Ok(Self { tokens: rounded(tokens, format)?, ids: Vec::new(), model, file_bytes: Some(bytes) })
    }
}

/// Samples `count` of `num_tokens` ids without replacement, ascending.
pub(crate) fn random_subset(num_tokens: usize, count: usize, mut rng: impl Rng) -> Vec<u32> {
    let mut ids: Vec<u32> = (0..num_tokens as u32).collect();
    ids.shuffle(&mut rng);
    ids.truncate(count);
    ids.sort_unstable();
    ids
}

/// Rounds tokens `[1, S, D]` like a scene file of the format.
fn rounded(tokens: Tokens, format: TokenFormat) -> Result<Tokens, EvalError> {
    if format == TokenFormat::F32 {
        return Ok(tokens);
    }
    let values = format.round(&tokens.to_host()?)?;
    Ok(tokens.with_host_values(values))
}

/// Returns the scene of stored tokens. Its normalization is that of no capture, which does not change the size of a file.
fn scene_of(clip: &Clip, codec: &TokenCodec, ids: &[u32], tokens: Vec<f32>, model_path: &str) -> Scene {
    Scene {
        key: clip.key.clone(),
        kind: codec.kind,
        model: codec.model.clone(),
        renderer_hash: codec.renderer_hash.clone(),
        model_path: model_path.into(),
        height: clip.context.height,
        width: clip.context.width,
        context: clip.context.cameras.clone(),
        context_frames: clip.context.frame_index.iter().map(|&frame| frame as u32).collect(),
        groups: vec![ContextGroup::of_all(clip.context.num_views())],
        world: PoseNormalization { mean_c2w: Pose::IDENTITY, scale: 1.0 },
        token_ids: ids.into(),
        tokens,
    }
}
