//! The decoder of LVSM's encoder-decoder: self-attention among the patches of a target view and all latents.
// B scenes, T target views, L latents, Q patches of a view, D width

use burn::module::Module;
use burn::nn::LayerNorm;
use burn::tensor::Tensor;

use crate::network::blocks::block::EncoderBlock;
use crate::network::config::ModelConfig;
use crate::network::init::Init;

/// A norm and self-attention blocks over `[patches; latents]`.
#[derive(Module, Debug)]
pub(crate) struct JointDecoder {
    input_norm: LayerNorm,
    blocks: Vec<EncoderBlock>,
    /// Whether the norm covers the patches too, as in LVSM's paper; in `CLiFT`'s release it covers the latents alone.
    #[module(skip)]
    normalizes_patches: bool,
}

impl JointDecoder {
    /// Makes the decoder of LVSM; `None` for other networks.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Option<Self> {
        config.has_latents().then(|| Self {
            input_norm: init.layer_norm(config.dim),
            blocks: (0..config.num_renderer_blocks).map(|i| EncoderBlock::new(config, init.block(Some(i)))).collect(),
            normalizes_patches: !config.variant.is_released(),
        })
    }

    pub fn num_blocks(&self) -> usize {
        self.blocks.len()
    }

    /// Joins the patches of every view with the latents of its scene: the input of the first block.
    ///
    /// # Shapes
    /// - `patches`: `[batch * views, num_queries, dim]`
    /// - `latents`: `[batch, num_latents, dim]`, or one set per view
    /// - returns `[batch * views, num_queries + num_latents, dim]`
    pub fn join(&self, patches: Tensor<3>, latents: Tensor<3>) -> Tensor<3> {
        let norm = |x| self.input_norm.forward(x);
        let latents = if self.normalizes_patches { latents } else { norm(latents) };
        let ([views, ..], [groups, count, dim]) = (patches.dims(), latents.dims());
        let of_views = latents.unsqueeze_dim::<4>(1).expand([groups, views / groups, count, dim]);
        let joined = Tensor::cat(vec![patches, of_views.reshape([views, count, dim])], 1);
        if self.normalizes_patches { norm(joined) } else { joined }
    }

    /// Applies a block. The last one returns the patches alone.
    ///
    /// # Shapes
    /// - `x`: `[batch * views, num_queries + num_latents, dim]`
    /// - returns the same, or `[batch * views, num_queries, dim]` from the last block
    pub fn block(&self, block: usize, x: Tensor<3>, num_latents: usize) -> Tensor<3> {
        let [_, rows, _] = x.dims();
        if block + 1 == self.blocks.len() {
            self.blocks[block].forward_first(x, rows - num_latents)
        } else {
            self.blocks[block].forward(x, None)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::architecture::CliftVariant;
    use crate::testing::{check_gradients, cpu_devices, random, small_lvsm, to_f64};

    #[test]
    fn gradients_equal_central_differences_in_f64() {
        for variant in [CliftVariant::Paper, CliftVariant::ReleasedRe10k] {
            for device in cpu_devices() {
                let config = ModelConfig { dim: 6, num_heads: 3, num_renderer_blocks: 2, ..small_lvsm(variant) };
                // PyTorch's distributions: LVSM's small matrices give near-uniform attention.
                let mut init = Init::new(5, &device);
                let joint = to_f64(JointDecoder::new(&config, &mut init).expect("of LVSM"));
                let forward = |[patches, latents]: [Tensor<3>; 2]| {
                    let joint = if patches.is_autodiff() { joint.clone().train() } else { joint.clone() };
                    (0..2).fold(joint.join(patches, latents), |x, block| joint.block(block, x, 2))
                };
                // Two views of each of two scenes.
                let inputs = [random([4, 3, 6], 6, &device), random([2, 2, 6], 7, &device)];
                check_gradients(inputs, forward, 1e-6);
            }
        }
    }
}
