//! Encoding of captured images as a scene: contexts, tokens, clusters, condenser.
// N encoder tokens, S stored tokens, D width

use burn::tensor::Device;
use clift_core::{ClipViews, derive_seed};
use clift_data::ClipReader;
use clift_model::{
    Clusters, ModelError, SceneClusters, TokenCount, TokenKind, TrainedModel, has_threads, map_in_threads,
};

use crate::encode::contexts::{Contexts, EncodeOptions};
use crate::error::SceneError;
use crate::scene::scene::{ContextGroup, Scene};

/// An encoded scene.
#[derive(Clone, Debug)]
pub struct EncodedScene {
    /// The scene.
    pub scene: Scene,
    /// Images and cameras of the context views.
    pub context: ClipViews,
    /// Clusters of the tokens.
    pub clusters: SceneClusters,
}

/// Encodes a scene of `reader`. The clusters of a single group equal those of `clift eval` for the same contexts and count.
pub fn encode(
    model: &TrainedModel,
    reader: &ClipReader,
    scene: usize,
    options: &EncodeOptions,
) -> Result<EncodedScene, SceneError> {
    let (key, data) = (reader.source.key(scene), &reader.options);
    let mut contexts = Contexts::choose(reader, scene, options)?;
    let num_tokens = model.config.num_tokens(contexts.num_members(), data.height, data.width)?;
    if options.stored_tokens.is_some_and(|count| count.of(num_tokens).is_err()) {
        // Few requested tokens make few groups; groups of small images hold fewer tokens than requested.
        contexts = Contexts::choose(reader, scene, &EncodeOptions { stored_tokens: None, ..options.clone() })?;
    }
    let Contexts { frames, groups, normalization } = contexts;
    let context = reader.read_views(scene, &frames, &normalization)?;
    let sizes: Vec<usize> = groups.iter().map(|group| group.views.len()).collect();
    let counts = token_counts(model, [data.height, data.width], &sizes, options.stored_tokens)?;
    let seed = derive_seed(derive_seed(options.seed, "eval"), key);

    let (mut tokens, mut assignment, mut token_ids) = (Vec::new(), Vec::new(), Vec::new());
    let groups_and_counts: Vec<(&ContextGroup, usize)> = groups.iter().zip(counts).collect();
    let num_patches = model.config.num_patches(1, data.height, data.width)?;
    let is_threaded = has_threads(model.device == Device::flex(), num_patches);
    let encoded = map_in_threads(is_threaded, &groups_and_counts, |(group, count)| {
        encode_group(model, &group.members(&context), *count, options, seed)
    })?;
    for (values, clusters) in encoded {
        // Tokens and patches are counted over all groups.
        let (first_cluster, first_patch) = (token_ids.len() as u32, assignment.len() as u32);
        assignment.extend(clusters.assignment().iter().map(|&cluster| first_cluster + cluster));
        token_ids.extend(clusters.centroid_index().iter().map(|&patch| first_patch + patch));
        tokens.extend(values);
    }
    let clusters = SceneClusters::new(assignment, token_ids.clone())?;
    debug_assert_eq!(tokens.len(), token_ids.len() * model.config.dim, "a row per centroid");
    let kind = match (model.config.architecture.supports_clusters(), model.has_condenser) {
        (false, _) => TokenKind::All,
        (true, true) => TokenKind::Clift,
        (true, false) => TokenKind::Kmeans,
    };
    let scene = Scene {
        key: key.into(),
        kind,
        model: model.config.clone(),
        renderer_hash: model.renderer_hash(),
        model_path: options.model_path.clone(),
        height: data.height,
        width: data.width,
        context: context.cameras.clone(),
        context_frames: frames.iter().map(|&frame| frame as u32).collect(),
        groups,
        world: normalization,
        token_ids,
        tokens,
    };
    Ok(EncodedScene { scene, context, clusters })
}

/// Returns the share of the tokens that is stored by default: a quarter of one group or half of several. Of many tokens, `MOST`
/// are stored, which `models/rooms` codes in about 360 kB, or an eighth if that is more.
fn default_share(num_tokens: usize, num_groups: usize) -> f64 {
    const MOST: f64 = 7168.0;
    (MOST / num_tokens as f64).clamp(0.125, if num_groups == 1 { 0.25 } else { 0.5 })
}

/// Returns the number of stored tokens of every group of `sizes` views: a share of its tokens, or an equal part of a number.
fn token_counts(
    model: &TrainedModel,
    [height, width]: [usize; 2],
    sizes: &[usize],
    stored_tokens: Option<TokenCount>,
) -> Result<Vec<usize>, ModelError> {
    let architecture = model.config.architecture;
    let all: Vec<usize> =
        sizes.iter().map(|&views| model.config.num_tokens(views, height, width)).collect::<Result<_, _>>()?;
    let sum: usize = all.iter().sum();
    if !architecture.supports_clusters() {
        return match stored_tokens {
            Some(count) if count.of(sum)? != sum => {
                let fix = format!("a scene of {architecture} is all its tokens, which are not clustered: write {sum}");
                Err(ModelError::BadConfig { key: "--stored-tokens", value: count.to_string(), fix })
            }
            _ => Ok(all),
        };
    }
    match stored_tokens.unwrap_or(TokenCount::Share(default_share(sum, sizes.len()))) {
        share @ TokenCount::Share(_) => all.iter().map(|&all| share.of(all)).collect(),
        count @ TokenCount::Count(_) => {
            let (count, groups) = (count.of(sum)?, sizes.len());
            if count < groups {
                let reason = format!("the scene has {groups} groups of views; write at least as many");
                return Err(ModelError::BadTokenCount { text: count.to_string(), reason });
            }
            let parts = (0..groups).map(|group| (count + group) / groups);
            Ok(parts.zip(all).map(|(part, all)| part.min(all)).collect())
        }
    }
}

/// Encodes the views of a group; returns the stored tokens `[S, D]` and the clusters.
fn encode_group(
    model: &TrainedModel,
    views: &ClipViews,
    count: usize,
    options: &EncodeOptions,
    seed: u64,
) -> Result<(Vec<f32>, SceneClusters), SceneError> {
    let lift = model.network.encode(&model.upload(views, &[TokenCount::Count(count)])?); // [1, N, D]
    let supports_clusters = model.config.architecture.supports_clusters();
    let clusters = if supports_clusters {
        let grid = [views.height, views.width].map(|side| side / model.config.patch_size);
        let kmeans = (&options.kmeans, seed);
        options.grouping.group(count, (views.num_views(), grid), kmeans, || lift.values.clone())?
    } else {
        SceneClusters::identity(count)
    };
    let index = Clusters::new(vec![clusters.clone()])?.upload(&model.device);
    let tokens = match (supports_clusters, model.has_condenser) {
        (false, _) => lift,
        (true, true) => model.network.compress(lift, &index),
        (true, false) => lift.centroids(&index),
    };
    Ok((tokens.to_host()?, clusters))
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;
    use clift_model::Network;

    use super::*;
    use crate::testing::small_clift;

    #[test]
    fn groups_have_equal_parts_of_a_number_of_tokens_or_a_share_each() {
        let config = small_clift();
        let network = Network::new(&config, 3, &Device::flex());
        let model = TrainedModel { network, config, has_condenser: true, device: Device::flex() };
        // Views of 2 x 3 patches.
        let counts =
            |sizes: &[usize], stored| token_counts(&model, [16, 24], sizes, stored).map_err(|error| error.to_string());
        assert_eq!(counts(&[4, 4, 2], None).unwrap(), [12, 12, 6]);
        assert_eq!(counts(&[4, 4, 4], Some(TokenCount::Count(20))).unwrap(), [6, 7, 7]);
        assert_eq!(counts(&[4, 1], Some(TokenCount::Count(30))).unwrap(), [15, 6], "no more than the group has");
        let shares = [(1024, 1), (40_000, 1), (2048, 2), (40_000, 40), (100_000, 90)]
            .map(|(all, groups)| default_share(all, groups));
        assert_eq!(shares, [0.25, 0.1792, 0.5, 0.1792, 0.125]);
        let message = counts(&[2, 2, 2], Some(TokenCount::Count(2))).unwrap_err();
        assert!(message.contains("the scene has 3 groups of views"), "{message}");
    }
}
