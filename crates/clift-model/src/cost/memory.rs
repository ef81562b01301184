//! Peak bytes of tensors, from the inputs that the hand-written operations save for the backward (docs/guide/training.md).
// x = N D: f32 values of the rows of a block

use crate::cost::largest_tensor::kmeans_values;
use crate::cost::parameters::Parameters;
use crate::cost::scene_sizes::SceneSizes;
use crate::network::blocks::feed_forward::Activation;
use crate::network::config::ModelConfig;
use crate::network::layers::{Layer, LayerKind, Part, Rows, TARGETS_AND_TOKENS};

const F32: f64 = 4.0;
/// Bytes of the C library's heap per byte that a backward pass keeps: the heap holds on to freed pieces below 32 MiB.
/// Measured: 1.05 to 1.22 (docs/guide/training.md).
const HEAP: f64 = 1.2;

/// Numbers of f32 values in a segment of a forward and backward pass of one scene.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Segment {
    /// Kept from the forward to the end of the segment's backward.
    pub kept: f64,
    /// Needed in addition during the backward: gradients and recomputed values.
    pub working: f64,
    /// Needed in addition during the forward.
    pub forward: f64,
    /// Parameters, whose gradients stay after the backward.
    pub parameters: f64,
}

/// Returns the most values alive at once in an update of `num_scenes` scenes. The forward accumulates the kept values; the
/// backward, from the last segment to the first, frees them and accumulates the gradients of parameters.
fn peak(segments: &[Segment], num_scenes: usize) -> f64 {
    let scenes = num_scenes as f64;
    let (mut kept, mut most) = (0.0_f64, 0.0_f64);
    for segment in segments {
        most = most.max(kept + scenes * segment.forward.max(segment.kept));
        kept += scenes * segment.kept;
    }
    let mut gradients = 0.0;
    for segment in segments.iter().rev() {
        gradients += segment.parameters;
        most = most.max(kept + scenes * segment.working + gradients);
        kept -= scenes * segment.kept;
    }
    most
}

/// Sizes of one micro-batch of an update.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UpdateSizes {
    /// Trained networks; the condenser runs only if it is trained.
    pub trained: &'static [Part],
    /// Scenes of the micro-batch.
    pub num_scenes: usize,
    /// Whether the gradients of several micro-batches are summed.
    pub is_accumulated: bool,
    /// Whether attention saves its inputs, and a feed-forward network the input of its GELU, in 16 bits: in bf16, and in f16 on
    /// GPUs with matrix instructions.
    pub saves_half: bool,
    /// Moments per value of a block's weight matrices: two with `AdamW`, one with Muon.
    pub matrix_moments: usize,
    /// Sizes of one scene.
    pub scene: SceneSizes,
    /// Values of a scene's context and target images.
    pub num_image_values: usize,
    /// Network of the perceptual loss on a scene's target views; zeros without one.
    pub loss: Segment,
    /// Parameters of the network of the perceptual loss.
    pub loss_parameters: f64,
}

/// Returns the peak bytes of tensors during an update, with weights and optimizer.
pub fn update_bytes(config: &ModelConfig, sizes: &UpdateSizes) -> f64 {
    let (layers, parameters) = (config.layers(), Parameters::of(config));
    let trained = parameters.of_parts(sizes.trained) as f64;
    let images = (sizes.num_scenes * sizes.num_image_values) as f64;
    let earlier = if sizes.is_accumulated { trained } else { 0.0 };
    let backward = HEAP * peak(&segments(config, &layers, sizes), sizes.num_scenes) + images + earlier;
    let matrices = layers.iter().filter(|layer| layer.block.is_some()).map(|layer| match layer.kind {
        LayerKind::Linear { inputs, outputs, .. } => (layer.part, (inputs * outputs) as f64),
        _ => (layer.part, 0.0),
    });
    let largest = matrices.clone().map(|(_, len)| len).fold(0.0, f64::max);
    let in_trained: f64 = matrices.filter(|(part, _)| sizes.trained.contains(part)).map(|(_, len)| len).sum();
    // Gradients, and the copies of a block's largest matrix during its update.
    let optimizer = trained + 5.0 * largest;
    // Two moments of the trained weights, or fewer of matrices.
    let moments = 2.0 * trained - (2 - sizes.matrix_moments) as f64 * in_trained;
    F32 * (parameters.total as f64 + sizes.loss_parameters + moments + backward.max(optimizer))
}

/// Returns the segments of a scene's share of an update, in the order of its forward pass.
fn segments(config: &ModelConfig, layers: &[Layer], sizes: &UpdateSizes) -> Vec<Segment> {
    let UpdateSizes { trained, scene, .. } = *sizes;
    let values = |rows: &[Rows]| scene.num_rows(rows) as f64 * config.dim as f64;
    let of_part = |part: Part| {
        let groups = layers.chunk_by(|a, b| (a.part, a.block) == (b.part, b.block));
        let groups = groups.filter(move |layers| layers[0].part == part);
        groups.map(move |layers| segment(config, layers, sizes, trained.contains(&part)))
    };
    let keep = |kept: f64| Segment { kept, ..Segment::default() };
    let mut segments: Vec<Segment> = of_part(Part::Encoder).collect();
    // The first reader of the tokens keeps them.
    let mut tokens = scene.num_tokens as f64 * config.dim as f64;
    segments.push(keep(tokens));
    if trained.contains(&Part::Condenser) {
        // Members are gathered once for all blocks; a condenser whose keys are all tokens gathers none.
        let gathers_members = layers.iter().any(|layer| layer.rows == [Rows::Members]);
        segments.push(keep(if gathers_members { values(&[Rows::Members]) } else { 0.0 }));
        segments.extend(of_part(Part::Condenser));
        tokens = values(&[Rows::StoredTokens]);
        segments.push(keep(tokens));
    }
    let projected = values(&[Rows::RenderTokens]);
    if projected < tokens {
        // Subsets that are smaller than the scene are gathered once for all blocks.
        segments.push(Segment { kept: projected, working: tokens, ..Segment::default() });
    }
    segments.extend(of_part(Part::Renderer));
    segments.push(sizes.loss);
    segments
}

/// Returns the segment of one block, or of consecutive layers outside the blocks. The kept values follow from the layers;
/// the additional ones from a formula per kind of block, which agrees with measured peaks.
fn segment(config: &ModelConfig, layers: &[Layer], sizes: &UpdateSizes, is_trained: bool) -> Segment {
    let UpdateSizes { scene, saves_half, .. } = sizes;
    let first = &layers[0];
    let values = |count: u64, width: usize| (count * width as u64) as f64;
    let x = values(scene.num_rows(first.rows), config.dim);
    let (mut saved, mut head_norms, mut hidden) = (0.0, 0.0, 0.0);
    // Saved in 16 bits, and the most of them that the backward has in f32 at once.
    let (mut in_half, mut restored) = (0.0, 0.0_f64);
    // For keys and values of other rows: needed in the backward, and in the forward.
    let (mut cross_working, mut cross_forward) = (0.0, 0.0);
    for layer in layers {
        let rows = scene.num_rows(layer.rows);
        let input = match layer.kind {
            LayerKind::Linear { inputs: width, .. } | LayerKind::LayerNorm { width, .. } => values(rows, width),
            LayerKind::Activation { width, .. } => {
                hidden = values(rows, width);
                hidden
            }
            LayerKind::Table { .. } => 0.0,
            LayerKind::HeadNorm { width, heads } => {
                // Measured: the values before and after, and half of them again.
                head_norms += 2.5 * values(rows, width * heads);
                0.0
            }
            LayerKind::Attention { width, keys, .. } | LayerKind::ClusterAttention { width, keys } => {
                let gathered = 2.0 * values(scene.num_gathered(keys), width);
                if matches!(layer.kind, LayerKind::ClusterAttention { .. }) {
                    (cross_working, cross_forward) = (3.0 * x + 1.5 * gathered, gathered / 2.0);
                } else if keys != layer.rows {
                    // Gradients of the gathered rows, of the projected rows, and of the tokens, summed over the blocks.
                    let projected = 2.0 * values(scene.num_rows(keys), width);
                    (cross_working, cross_forward) = (3.0 * x + gathered + 2.0 * projected, projected);
                }
                values(rows, width) + gathered
            }
        };
        saved += if layer.saves_input { input } else { 0.0 };
        let is_rounded = match layer.kind {
            LayerKind::Attention { .. } => true,
            // ReLU is not an operation of its own.
            LayerKind::Activation { activation, .. } => activation == Activation::Gelu,
            _ => false,
        };
        if *saves_half && is_rounded {
            (in_half, restored) = (in_half + input, restored.max(input));
        }
    }
    let parameters = layers.iter().map(Layer::num_parameters).sum::<u64>() as f64;
    let rgb = values(scene.num_rows(first.rows), config.rgb_patch_len());
    match first.block {
        Some(_) if !is_trained => Segment { forward: forward_values(config, x) + x, ..Segment::default() },
        Some(_) => {
            let kept = saved + head_norms - in_half / 2.0;
            // Gradients of the residual stream and of the hidden values, and the recomputed norm.
            let working = (2.0 * x + hidden).max(cross_working - hidden) + restored;
            let forward = saved + hidden + cross_forward;
            Segment { kept, working, forward, parameters }
        }
        // Patches are gathered from images and rays, with 15 values per pixel in between.
        None if matches!(first.kind, LayerKind::Linear { .. }) => {
            let forward = saved * 2.5 + x;
            let (kept, parameters) = if is_trained { (saved, parameters) } else { (0.0, 0.0) };
            Segment { kept, working: x, forward, parameters }
        }
        // Input of the norm, result of the sigmoid, difference; images and their gradients in two orders.
        None => Segment { kept: saved + 2.0 * rgb, working: 2.0 * x + 3.0 * rgb, forward: 4.0 * rgb, parameters },
    }
}

/// Values alive in a block's forward without autodiff, besides its input of `x` values.
fn forward_values(config: &ModelConfig, x: f64) -> f64 {
    // Result of the norm and three projections, or the hidden values before and after GELU.
    x * (2.0 * config.feed_forward_dim as f64 / config.dim as f64).max(4.0)
}

/// Sizes of encoding, clustering and rendering one scene without gradients.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InferenceSizes {
    /// Parameters of all networks in memory.
    pub num_parameters: u64,
    /// Parameters read from a file into an existing network.
    pub num_loaded: u64,
    /// Most rows of a layer of the encoder.
    pub num_encoder_rows: usize,
    /// Encoder tokens.
    pub num_tokens: usize,
    /// Largest number of clusters; `None` without K-means.
    pub num_clusters: Option<usize>,
    /// Target views rendered at once.
    pub num_targets: usize,
    /// Patches per view.
    pub num_patches: usize,
    /// Values of all images of the scene.
    pub num_image_values: usize,
    /// Peak values of a metric's network, without its parameters.
    pub metric_working: f64,
    /// Parameters of a metric's network.
    pub metric_parameters: f64,
}

/// Returns the peak bytes of tensors while a scene is encoded, clustered and rendered.
pub fn inference_bytes(config: &ModelConfig, sizes: &InferenceSizes) -> f64 {
    let values = |rows: usize| (rows * config.dim) as f64;
    let x = values(sizes.num_tokens);
    let patches = (sizes.num_encoder_rows * config.context_patch_len()) as f64;
    let rows = values(sizes.num_encoder_rows);
    let encode = (rows + forward_values(config, rows)).max(2.5 * patches + rows);
    // Centered tokens, and the table of distances that the seeding reads.
    let distances = |num_clusters| 2.0 * x + kmeans_values(sizes.num_tokens, num_clusters) as f64;
    let kmeans = sizes.num_clusters.map_or(0.0, distances);
    let render = match sizes.num_targets {
        0 => 0.0,
        num_targets => render_values(config, x, num_targets, values(num_targets * sizes.num_patches)),
    };
    let working = sizes.num_image_values as f64 + encode.max(kmeans).max(render).max(sizes.metric_working);
    // While a file is loaded, its bytes and its tensors are in memory.
    let working = working.max(2.0 * sizes.num_loaded as f64);
    F32 * (sizes.num_parameters as f64 + sizes.metric_parameters + working)
}

/// Returns the peak bytes of tensors, without weights, while `num_views` views of `num_patches` patches in total are rendered
/// from `num_render_tokens` tokens.
pub fn render_bytes(config: &ModelConfig, num_render_tokens: usize, num_views: usize, num_patches: usize) -> u64 {
    let values = |rows: usize| (rows * config.dim) as f64;
    let image = (num_patches * config.rgb_patch_len()) as f64;
    // Rays of the pixels (twice the image), patches, image, and its copy on the host.
    (F32 * (render_values(config, values(num_render_tokens), num_views, values(num_patches)) + 5.0 * image)) as u64
}

/// Values of one block: keys and values of tokens of `x` values, and the forward of views of `y` values; or the tokens, and
/// the forward of views that each have all tokens among their rows.
fn render_values(config: &ModelConfig, x: f64, num_views: usize, y: f64) -> f64 {
    let joins_tokens = |layer: &Layer| layer.part == Part::Renderer && layer.rows == TARGETS_AND_TOKENS;
    if config.layers().iter().any(joins_tokens) {
        let y = y + num_views as f64 * x;
        return x + y + forward_values(config, y);
    }
    3.0 * x + y + forward_values(config, y)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn update_bytes_are_within_15_percent_of_measured_peaks() {
        const STAGE1: &[Part] = &[Part::Encoder, Part::Renderer];
        const STAGE2: &[Part] = &[Part::Condenser, Part::Renderer];
        // docs/results/performance.md, full size, batch 1; the process holds 26 MB besides its tensors.
        let config = ModelConfig::default();
        let scene = SceneSizes::new(4096, 1, 1024);
        let stored = SceneSizes { num_storage_tokens: Some(1024), num_render_tokens: 1024, ..scene };
        for (trained, saves_half, scene, measured) in
            [(STAGE1, false, scene, 2.26e9), (STAGE1, true, scene, 2.03e9), (STAGE2, false, stored, 1.43e9)]
        {
            let one = UpdateSizes {
                trained,
                num_scenes: 1,
                is_accumulated: false,
                saves_half,
                matrix_moments: 2,
                scene,
                num_image_values: 5 * 256 * 256 * 3,
                loss: Segment::default(),
                loss_parameters: 0.0,
            };
            let predicted = update_bytes(&config, &one) + 26e6;
            let error = (predicted / measured - 1.0).abs();
            assert!(error < 0.15, "{one:?}: {predicted:.3e} for {measured:.3e}");
            let muon = UpdateSizes { matrix_moments: 1, ..one };
            assert!(update_bytes(&config, &muon) < update_bytes(&config, &one), "one moment less per matrix");
            for more in [UpdateSizes { num_scenes: 2, ..one }, UpdateSizes { is_accumulated: true, ..one }] {
                assert!(update_bytes(&config, &more) > update_bytes(&config, &one), "{more:?}");
            }
        }
    }

    #[test]
    fn peak_is_the_largest_sum_of_kept_working_and_gradients() {
        let segment = |kept, working, forward, parameters| Segment { kept, working, forward, parameters };
        // At the start of the backward, at its end by the gradients, the same of two scenes, and in the forward.
        assert_eq!(peak(&[segment(5.0, 1.0, 0.0, 1.0), segment(5.0, 2.0, 0.0, 1.0)], 1), 13.0);
        assert_eq!(peak(&[segment(1.0, 1.0, 0.0, 10.0), segment(1.0, 1.0, 0.0, 10.0)], 1), 22.0);
        assert_eq!(peak(&[segment(1.0, 1.0, 0.0, 10.0), segment(1.0, 1.0, 0.0, 10.0)], 2), 24.0);
        assert_eq!(peak(&[segment(1.0, 0.0, 9.0, 0.0), segment(2.0, 1.0, 0.0, 0.0)], 1), 9.0);
    }
}
