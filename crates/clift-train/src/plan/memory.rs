//! Bytes that the parts of a run need, counted from what the hand-written operations keep (docs/guide/training.md).
// In f32 values: x = N D of a part's scenes, y = T Q D, z = tokens D

use clift_eval::vgg::VggSizes;
use clift_model::ModelConfig;

use super::counts::{Parameters, SceneSizes, condenser_block, decoder_block, encoder_block};
use super::tape::{Part, peak};
use crate::events::Stage;

/// Bytes of an f32.
const F32: f64 = 4.0;

/// What the C library's heap holds for a byte of what a backward pass keeps: freed pieces below 32 MiB stay in it.
/// Measured at 1.05 to 1.22 (docs/guide/training.md).
const HEAP: f64 = 1.2;

/// Above this many values K-means asks the device for every distance instead of keeping a table.
const MAX_KMEANS_TABLE: f64 = (1_u64 << 26) as f64;

/// One part of an update: some scenes of a batch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UpdateSizes {
    /// Stage 1 or stage 2.
    pub stage: Stage,
    /// Scenes worked off at once.
    pub num_scenes: f64,
    /// Whether there are more parts, whose gradients are added up.
    pub is_accumulated: bool,
    /// Whether every block keeps its input alone.
    pub recompute: bool,
    /// One scene.
    pub scene: SceneSizes,
    /// Values of a scene's pictures, context and target.
    pub num_picture_values: f64,
    /// The network of the perceptual loss on one target picture.
    pub perceptual: Option<VggSizes>,
}

/// Most bytes of tensors alive during an update, weights and optimiser included.
pub fn update_bytes(config: &ModelConfig, sizes: &UpdateSizes) -> f64 {
    let parameters = Parameters::of(config);
    let trained = parameters.trained(sizes.stage) as f64;
    let parts = parts(config, sizes);
    let pictures = sizes.num_scenes * sizes.num_picture_values;
    let earlier = if sizes.is_accumulated { trained } else { 0.0 };
    let backward = HEAP * peak(&parts) + pictures + earlier;
    // Gradients, and a few copies of the largest matrix on the way to its update.
    let optimizer = trained + 5.0 * largest_matrix(config);
    // Weights, and two moments of those that train.
    let standing = parameters.total as f64 + sizes.perceptual.map_or(0.0, |vgg| vgg.parameters) + 2.0 * trained;
    F32 * (standing + backward.max(optimizer))
}

fn largest_matrix(config: &ModelConfig) -> f64 {
    (config.dim * (3 * config.dim).max(config.feed_forward_dim)) as f64
}

/// The parts of an update in the order of its forward pass.
fn parts(config: &ModelConfig, sizes: &UpdateSizes) -> Vec<Part> {
    let UpdateSizes { stage, num_scenes, recompute, scene, .. } = *sizes;
    let dim = config.dim as f64;
    let x = num_scenes * scene.num_tokens * dim;
    let y = num_scenes * scene.num_targets * scene.num_patches * dim;
    let mut parts = Vec::new();
    // Patches are gathered from pictures and rays, 15 values a pixel on the way.
    let pixels = |patch_len: usize, count: f64| num_scenes * count * patch_len as f64;
    let context = pixels(config.context_patch_len(), scene.num_tokens);
    let embed = |patches: f64, values: f64, trains: bool, parameters: u64| Part {
        kept: if trains { patches } else { 0.0 },
        working: values,
        forward: patches * 2.5 + values,
        parameters: if trains { parameters as f64 } else { 0.0 },
    };
    let linear = |inputs: usize, outputs: usize| (inputs * outputs + outputs) as u64;
    let trains_encoder = stage != Stage::Stage2;
    parts.push(embed(context, x, trains_encoder, linear(config.context_patch_len(), config.dim)));
    for _ in 0..config.num_encoder_blocks {
        parts.push(if trains_encoder {
            keeping(recompute, x, encoder_part(config, x))
        } else {
            Part { forward: forward_values(config, x) + x, ..Part::default() }
        });
    }
    // The tokens themselves are kept by the first who reads them.
    let mut tokens = x;
    parts.push(Part { kept: x, ..Part::default() });
    if let (Stage::Stage2, Some(stored)) = (stage, scene.num_storage_tokens) {
        let w = num_scenes * stored * dim;
        // The released networks read the tokens as they are, which are kept already.
        let is_released = config.variant.is_released();
        let members = if is_released { x } else { (x - w).max(0.0) };
        parts.push(Part { kept: if is_released { 0.0 } else { members }, ..Part::default() });
        for _ in 0..config.condenser.num_blocks {
            parts.push(keeping(recompute, w, condenser_part(config, w, members)));
        }
        parts.push(Part { kept: w, ..Part::default() });
        tokens = w;
    }
    let projected = num_scenes * scene.num_projected() * dim;
    if projected < tokens {
        // Subsets smaller than the scene are gathered first, and shared by all blocks.
        parts.push(Part { kept: projected, working: tokens, ..Part::default() });
    }
    let groups = if scene.is_per_view { scene.num_targets } else { 1.0 };
    let memory = 2.0 * num_scenes * groups * scene.num_render_tokens * dim;
    let rays = pixels(config.ray_patch_len(), scene.num_targets * scene.num_patches);
    parts.push(embed(rays, y, true, linear(config.ray_patch_len(), config.dim)));
    for _ in 0..config.num_renderer_blocks {
        parts.push(keeping(recompute, y, decoder_part(config, y, memory, 2.0 * projected)));
    }
    // The norm's input, the sigmoid's result, the difference; pictures and their gradients in two orders.
    let rgb = pixels(config.rgb_patch_len(), scene.num_targets * scene.num_patches);
    let parameters = 2 * config.dim as u64 + linear(config.dim, config.rgb_patch_len());
    parts.push(Part {
        kept: y + 2.0 * rgb,
        working: 2.0 * y + 3.0 * rgb,
        forward: 4.0 * rgb,
        parameters: parameters as f64,
    });
    if let Some(vgg) = sizes.perceptual {
        let pictures = num_scenes * scene.num_targets;
        // Layers are kept before and behind their ReLU; what the targets are in the network is there until the
        // differences are; a convolution orders its input anew.
        parts.push(Part {
            kept: pictures * (2.0 * vgg.outputs + vgg.features),
            working: pictures * 3.0 * vgg.widest,
            forward: pictures * (2.0 * vgg.outputs + 2.0 * vgg.features + 2.0 * vgg.widest),
            parameters: 0.0,
        });
    }
    parts
}

/// A part that keeps only its input where blocks are computed again.
fn keeping(recompute: bool, input: f64, part: Part) -> Part {
    if recompute { Part { kept: input, working: part.working + part.kept, ..part } } else { part }
}

/// `F / D`: the hidden values of a feed-forward network over its inputs.
fn widening(config: &ModelConfig) -> f64 {
    config.feed_forward_dim as f64 / config.dim as f64
}

/// Values alive in a block's forward without a tape, beside its input.
fn forward_values(config: &ModelConfig, x: f64) -> f64 {
    // The norm's result and the three projections, or the hidden values before and after their GELU.
    x * (2.0 * widening(config)).max(4.0)
}

/// What the norms of the heads' queries and keys keep of `values` of them: before and after, and beside their values.
fn head_norms(config: &ModelConfig, values: f64) -> f64 {
    if config.variant.has_norms() { 2.5 * values } else { 0.0 }
}

fn encoder_part(config: &ModelConfig, x: f64) -> Part {
    let hidden = widening(config) * x;
    Part {
        // Input, queries, keys and values, attention's result, the second input, hidden values.
        kept: 6.0 * x + hidden + head_norms(config, 2.0 * x),
        // The gradients of the sum and of the hidden values, and the norm computed again.
        working: 2.0 * x + hidden,
        forward: 6.0 * x + 2.0 * hidden,
        parameters: encoder_block(config) as f64,
    }
}

fn decoder_part(config: &ModelConfig, y: f64, memory: f64, projected: f64) -> Part {
    let hidden = widening(config) * y;
    // Input, queries, keys, values, result; input, query and result of the cross-attention; the third input.
    let of_views = 9.0 * y + hidden;
    let feed_forward = 2.0 * y + hidden;
    // The gradient of what the views gathered, of what was projected, and of the tokens, added up over the blocks.
    let cross = 3.0 * y + memory + projected + projected - hidden;
    Part {
        kept: of_views + memory + head_norms(config, 3.0 * y + projected / 2.0),
        working: feed_forward.max(cross),
        forward: of_views + hidden + memory + projected,
        parameters: decoder_block(config) as f64,
    }
}

fn condenser_part(config: &ModelConfig, w: f64, members: f64) -> Part {
    let hidden = widening(config) * w;
    Part {
        kept: 10.0 * w + hidden + 2.0 * members + head_norms(config, 3.0 * w + members),
        working: (2.0 * w + hidden).max(3.0 * w + 3.0 * members - hidden),
        forward: 10.0 * w + 2.0 * hidden + 3.0 * members,
        parameters: condenser_block(config) as f64,
    }
}

/// What is needed to encode, cluster and draw one scene without gradients.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InferenceSizes {
    /// Encoder tokens.
    pub num_tokens: f64,
    /// Most clusters that K-means makes; `None` where it does not run.
    pub num_clusters: Option<f64>,
    /// Target views that are drawn at once; 0 for none.
    pub num_targets: f64,
    /// Patches of a view.
    pub num_patches: f64,
    /// Values of all the scene's pictures.
    pub num_picture_values: f64,
    /// Weights that are read from a file into a network that is there already.
    pub num_loaded: f64,
    /// The network of LPIPS on one picture, and how many targets' features are held.
    pub lpips: Option<(VggSizes, f64)>,
}

/// Keys and values of one block for tokens of `x` values, and the hidden values of views of `y`.
fn render_values(config: &ModelConfig, x: f64, y: f64) -> f64 {
    3.0 * x + y + forward_values(config, y)
}

/// Most bytes of tensors alive while views of so many patches in all are drawn from so many tokens, weights aside.
pub fn drawing_bytes(config: &ModelConfig, num_render_tokens: usize, num_patches: usize) -> u64 {
    let values = |count: usize| count as f64 * config.dim as f64;
    let picture = (num_patches * config.patch_size.pow(2) * 3) as f64;
    // The rays of the pixels are twice the picture; it is unfolded from patches, and copied to the host.
    (F32 * (render_values(config, values(num_render_tokens), values(num_patches)) + 5.0 * picture)) as u64
}

/// Most bytes of tensors alive while `parameters` weights encode, cluster and draw a scene.
pub fn inference_bytes(config: &ModelConfig, parameters: f64, sizes: &InferenceSizes) -> f64 {
    let dim = config.dim as f64;
    let x = sizes.num_tokens * dim;
    let y = sizes.num_targets * sizes.num_patches * dim;
    let patches = sizes.num_tokens * config.context_patch_len() as f64;
    let encode = (x + forward_values(config, x)).max(2.5 * patches + x);
    let kmeans = sizes.num_clusters.map_or(0.0, |clusters| {
        let table = sizes.num_tokens * sizes.num_tokens;
        let table = if table <= MAX_KMEANS_TABLE { table } else { 0.0 };
        // The tokens about their mean; the table, or one score per token and cluster.
        2.0 * x + table.max(sizes.num_tokens * clusters)
    });
    let render = if sizes.num_targets > 0.0 { render_values(config, x, y) } else { 0.0 };
    // What the pictures are in its layers, unit vectors of it, and one layer computed from another.
    let (lpips, held) = sizes.lpips.map_or((0.0, 0.0), |(vgg, targets)| {
        // Its file is whole in memory while its weights are taken out.
        let drawing = targets * vgg.features + 2.0 * vgg.features + 3.0 * vgg.widest;
        (drawing.max(vgg.parameters), vgg.parameters)
    });
    let working = sizes.num_picture_values + encode.max(kmeans).max(render).max(lpips);
    // A file's bytes are there until its tensors are, and both until they have replaced others.
    F32 * (parameters + held + working.max(2.0 * sizes.num_loaded))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn update(stage: Stage, recompute: bool) -> UpdateSizes {
        let scene = SceneSizes {
            num_tokens: 4096.0,
            num_storage_tokens: (stage == Stage::Stage2).then_some(1024.0),
            num_render_tokens: if stage == Stage::Stage2 { 1024.0 } else { 4096.0 },
            is_per_view: false,
            num_targets: 1.0,
            num_patches: 1024.0,
        };
        let num_picture_values = 5.0 * 256.0 * 256.0 * 3.0;
        UpdateSizes {
            stage,
            num_scenes: 1.0,
            is_accumulated: false,
            recompute,
            scene,
            num_picture_values,
            perceptual: None,
        }
    }

    #[test]
    fn the_papers_update_is_within_fifteen_percent_of_its_measured_peak() {
        // docs/results/performance.md, full size, batch 1; a process of this program holds 26 MB besides its tensors.
        let config = ModelConfig::default();
        for (stage, recompute, measured) in
            [(Stage::Stage1, false, 2.26e9), (Stage::Stage1, true, 1.72e9), (Stage::Stage2, false, 1.43e9)]
        {
            let counted = update_bytes(&config, &update(stage, recompute)) + 26e6;
            assert!((counted / measured - 1.0).abs() < 0.15, "{stage:?} {recompute}: {counted:.3e} for {measured:.3e}");
        }
    }

    #[test]
    fn memory_grows_with_scenes_and_shrinks_when_blocks_are_computed_again() {
        let config = ModelConfig::default();
        let one = update(Stage::Stage1, false);
        let two = UpdateSizes { num_scenes: 2.0, ..one };
        let again = UpdateSizes { num_scenes: 2.0, ..update(Stage::Stage1, true) };
        let bytes = |sizes: &UpdateSizes| update_bytes(&config, sizes);
        assert!(bytes(&two) > 1.3 * bytes(&one));
        assert!(bytes(&again) < 0.7 * bytes(&two));
        assert!(bytes(&UpdateSizes { is_accumulated: true, ..one }) > bytes(&one));
    }
}
