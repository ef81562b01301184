//! Encoding of captured images as a scene: contexts, tokens, clusters, condenser.
// N encoder tokens, S stored tokens, D width

use clift_core::derive_seed;
use clift_data::{ClipReader, ViewIndices, ViewSampler};
use clift_model::{Clusters, Grouping, KMeans, ModelError, SceneClusters, TokenCount, TokenKind, TrainedModel, Views};

use crate::encode::contexts::contexts;
use crate::error::SceneError;
use crate::scene::scene::Scene;

/// Settings of [`encode`].
#[derive(Clone, Debug, PartialEq)]
pub struct EncodeOptions {
    /// Context frames; `None` for `num_context` frames along the camera path.
    pub context: Option<Vec<usize>>,
    /// Number of context views without `context`, such as the number in training.
    pub num_context: usize,
    /// Number of stored tokens; `None` for a quarter, or all tokens of a network without clusters.
    pub stored_tokens: Option<TokenCount>,
    /// Token groups that the model was trained on.
    pub grouping: Grouping,
    /// Latent K-means.
    pub kmeans: KMeans,
    /// Seed of the run.
    pub seed: u64,
    /// Path of the model for the scene file, see [`Scene::model_path_for`].
    pub model_path: String,
}

impl Default for EncodeOptions {
    /// The options for the default config of a run.
    fn default() -> Self {
        Self {
            context: None,
            num_context: ViewSampler::default().max_context,
            stored_tokens: None,
            grouping: Grouping::default(),
            kmeans: KMeans::default(),
            seed: 0,
            model_path: String::new(),
        }
    }
}

/// An encoded scene.
#[derive(Clone, Debug)]
pub struct EncodedScene {
    /// The scene.
    pub scene: Scene,
    /// Number of tokens before clustering.
    pub num_lift_tokens: usize,
    /// Variance within clusters as a share of the total variance of the tokens.
    pub cluster_error: f64,
    /// Clusters of the tokens.
    pub clusters: SceneClusters,
}

impl EncodedScene {
    /// Orders the tokens by their patches, as files with coded tokens do.
    ///
    /// # Errors
    /// The errors of the clusters, which stay valid.
    pub fn sort_tokens(&mut self) -> Result<(), SceneError> {
        let (ids, dim) = (&self.scene.token_ids, self.scene.model.dim);
        let mut order: Vec<usize> = (0..ids.len()).collect();
        order.sort_by_key(|&token| ids[token]);
        let mut place = vec![0; ids.len()];
        order.iter().enumerate().for_each(|(new, &old)| place[old] = new as u32);
        let assignment = self.clusters.assignment().iter().map(|&cluster| place[cluster as usize]).collect();
        let tokens = order.iter().flat_map(|&old| &self.scene.tokens[old * dim..(old + 1) * dim]).copied().collect();
        self.scene.token_ids = order.iter().map(|&old| ids[old]).collect();
        self.scene.tokens = tokens;
        self.clusters = SceneClusters::new(assignment, self.scene.token_ids.clone())?;
        Ok(())
    }
}

/// Encodes a scene of `reader`. The groups equal those of `clift eval` for the same contexts and count.
///
/// # Errors
/// [`ModelError::BadConfig`] for frames that the scene does not have, [`ModelError::BadTokenCount`] for a count above the
/// number of tokens, [`ModelError::BadConfig`] for fewer tokens than all of a network without clusters, and the errors of reading the images.
pub fn encode(
    model: &TrainedModel,
    reader: &ClipReader,
    scene: usize,
    options: &EncodeOptions,
) -> Result<EncodedScene, SceneError> {
    let (key, data) = (reader.source.key(scene), &reader.options);
    let (context, frame) = contexts(reader, scene, options.context.as_deref(), options.num_context)?;
    let views = ViewIndices { context, target: Vec::new() };
    let clip = reader.read(scene, &views)?;

    let lift = model.network.encode(&Views::upload(&[&clip.context], &model.device)?); // [1, N, D]
    let [_, num_lift_tokens, dim] = lift.dims();
    let seed = derive_seed(derive_seed(options.seed, "eval"), key);
    let architecture = model.config.architecture;
    let clusters = if architecture.supports_clusters() {
        let grid = [data.height, data.width].map(|side| side / model.config.patch_size);
        let count = options.stored_tokens.unwrap_or(TokenCount::Share(0.25));
        let (count, kmeans) = (count.of(num_lift_tokens)?, (&options.kmeans, seed));
        options.grouping.group(count, (clip.context.num_views(), grid), kmeans, || lift.values.clone())?
    } else {
        if let Some(count) = options.stored_tokens
            && count.of(num_lift_tokens)? != num_lift_tokens
        {
            let fix = format!(
                "a scene of {architecture} is all its tokens, which are not clustered: write {num_lift_tokens}"
            );
            return Err(ModelError::BadConfig { key: "--stored-tokens", value: count.to_string(), fix }.into());
        }
        SceneClusters::identity(num_lift_tokens)
    };
    let cluster_error = clusters.variance_within(&lift.to_host()?);
    let index = Clusters::new(vec![clusters.clone()])?.upload(&model.device);
    let (kind, tokens) = if !architecture.supports_clusters() {
        (TokenKind::All, lift)
    } else if model.has_condenser {
        (TokenKind::Clift, model.network.compress(lift, &index))
    } else {
        (TokenKind::Kmeans, lift.centroids(&index))
    };
    let tokens = tokens.to_host()?;
    let token_ids = clusters.centroid_index().to_vec();
    debug_assert_eq!(tokens.len(), token_ids.len() * dim, "a row per centroid");
    let scene = Scene {
        key: key.into(),
        kind,
        model: model.config.clone(),
        renderer_hash: model.renderer_hash(),
        model_path: options.model_path.clone(),
        height: data.height,
        width: data.width,
        context: clip.context.cameras,
        context_frames: views.context.iter().map(|&frame| frame as u32).collect(),
        world: frame,
        token_ids,
        tokens,
    };
    Ok(EncodedScene { scene, num_lift_tokens, cluster_error, clusters })
}
