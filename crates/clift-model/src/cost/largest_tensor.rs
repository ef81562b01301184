//! The largest tensors of a network. A tensor is one buffer, of which a GPU's shader sees at most
//! `max_storage_buffer_binding_size` (below 2 GiB on Vulkan and Direct3D 12).

use crate::cost::scene_sizes::SceneSizes;
use crate::error::ModelError;
use crate::network::config::ModelConfig;
use crate::network::layers::{Layer, LayerKind, Part, Sequence};
use crate::ops::composed::attention::MAX_SCORES;
use crate::tokens::count::TokenCount;
use crate::tokens::kmeans::seeding::{MAX_TABLE_LEN, pool_len};

/// Lists the tensors of one network that can be its largest, for a batch of equal scenes: description and number of
/// values.
pub fn largest_tensors(config: &ModelConfig, part: Part, sizes: &SceneSizes, num_scenes: usize) -> Vec<(String, u64)> {
    let layers = config.layers();
    layers.iter().filter(|layer| layer.part == part).filter_map(|layer| tensor(layer, sizes, num_scenes)).collect()
}

/// Returns the largest tensor of a layer; `None` for layers whose block always has a larger one.
fn tensor(layer: &Layer, sizes: &SceneSizes, num_scenes: usize) -> Option<(String, u64)> {
    let network = match layer.part {
        Part::Encoder => "encoder",
        Part::TokenNorm => "token norm",
        Part::Condenser => "condenser",
        Part::Renderer => "renderer",
    };
    let scenes = num_scenes as u64;
    let rows = scenes * sizes.num_rows(layer.rows);
    let name = layer.path.rsplit('.').next().unwrap_or_default();
    Some(match (layer.kind, name) {
        (LayerKind::Linear { inputs, .. }, "patch_embed") => {
            ("the context pixels with their rays".into(), rows * inputs as u64)
        }
        (LayerKind::Linear { inputs, .. }, "ray_embed") => ("the target rays".into(), rows * inputs as u64),
        (LayerKind::Linear { outputs, .. }, "in_proj") => {
            (format!("the {network}'s queries, keys and values"), rows * outputs as u64)
        }
        (LayerKind::Linear { outputs, .. }, "kv_proj") => {
            let tokens = if layer.part == Part::Condenser { "members" } else { "tokens" };
            let gathered = scenes * sizes.num_gathered(layer.rows);
            (format!("the keys and values of the {network}'s {tokens}"), rows.max(gathered) * outputs as u64)
        }
        (LayerKind::Attention { heads, keys, .. }, _) => {
            (format!("a chunk of the {network}'s scores"), scores(rows, heads, keys, sizes, scenes))
        }
        (LayerKind::Activation { width, .. }, _) => {
            (format!("the {network}'s feed-forward values"), rows * width as u64)
        }
        _ => return None,
    })
}

/// Number of scores in memory at once: those of a chunk of queries, at least of one query.
fn scores(num_queries: u64, heads: usize, keys: Sequence, sizes: &SceneSizes, scenes: u64) -> u64 {
    let groups = scenes * sizes.num_groups(keys);
    let scores_per_query = (groups * heads as u64 * sizes.group_len(keys)).max(1);
    scores_per_query * (MAX_SCORES as u64 / scores_per_query).clamp(1, (num_queries / groups.max(1)).max(1))
}

/// Returns the number of distances in the largest tensor of latent K-means, the table that its seeding reads.
pub fn kmeans_values(num_tokens: usize, num_clusters: usize) -> u64 {
    pool_len(num_tokens, num_clusters, MAX_TABLE_LEN) as u64 * num_tokens as u64
}

/// Refuses `[views, height, width]` whose encoding, or storing one of the numbers of tokens, takes a tensor of more than `limit`
/// bytes.
pub(crate) fn check_encoding(
    config: &ModelConfig,
    [num_views, height, width]: [usize; 3],
    stored_tokens: &[TokenCount],
    limit: u64,
) -> Result<(), ModelError> {
    let sizes = SceneSizes::of(config, num_views, 1, [height, width])?;
    let mut tensors = largest_tensors(config, Part::Encoder, &sizes, 1);
    let counts = stored_tokens.iter().filter_map(|count| count.of(sizes.num_tokens).ok());
    for count in counts.filter(|_| config.architecture.supports_clusters()) {
        let stored = SceneSizes { num_storage_tokens: Some(count), ..sizes };
        tensors.extend(largest_tensors(config, Part::Condenser, &stored, 1));
        // All tokens are stored without clustering.
        if count < sizes.num_tokens {
            tensors.push(("the distances of K-means".into(), kmeans_values(sizes.num_tokens, count)));
        }
    }
    let bytes = |values: u64| values * size_of::<f32>() as u64;
    match tensors.into_iter().max_by_key(|(_, values)| *values) {
        Some((what, values)) if bytes(values) > limit => {
            Err(ModelError::TensorTooLarge { what, bytes: bytes(values), limit, num_views })
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The paper's network on 64 views of 1,024 tokens.
    #[test]
    fn a_tensor_has_at_most_the_bytes_of_the_limit() {
        let check = |stored, limit| {
            check_encoding(&ModelConfig::default(), [64, 256, 256], &[TokenCount::Share(stored)], limit)
        };
        // Queries, keys and values of 3 x 768 values. All tokens are stored without distances.
        let bytes = 64 * 1024 * 3 * 768 * 4;
        assert!(check(1.0, bytes).is_ok() && check(0.001, bytes).is_ok());
        let message = check(1.0, bytes - 1).unwrap_err().to_string();
        assert!(message.contains("64 context views") && message.contains(&bytes.to_string()), "{message}");
        let message = check(0.5, bytes).unwrap_err().to_string();
        assert!(message.starts_with("the distances of K-means"), "{message}");
    }
}
