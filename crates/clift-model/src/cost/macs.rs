//! Multiply-accumulates of the networks, and conventions to count them.

use std::iter::Sum;

use strum::{Display, IntoStaticStr, VariantArray};

use crate::cost::scene_sizes::SceneSizes;
use crate::error::ModelError;
use crate::network::config::ModelConfig;
use crate::network::layers::{Layer, LayerKind, Part, RENDER_TOKENS, Rows};

/// Multiply-accumulates of a forward pass of one scene, without activations, softmax and the rays of pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Macs {
    /// Multiply-accumulates of linear layers.
    pub linear: u64,
    /// Multiply-accumulates of scores (`Q K^T`) and weighted sums (`A V`).
    pub attention: u64,
    /// Values that layer norms normalize.
    pub normalized: u64,
}

/// Convention for the cost of a forward pass.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Display, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "lowercase")]
pub enum FlopConvention {
    /// The paper's render-budget table: one per multiply-accumulate of linear layers, none for attention, five per value
    /// of `3 L + 2` layer norms. fvcore counts linear layers and fused attention so; the number of norms is fitted to the
    /// five printed values (the network has `3 L + 1`).
    Paper,
    /// Multiply-accumulates, attention included.
    #[default]
    Macs,
}

impl FlopConvention {
    /// Returns the unit of 1e9 counts.
    pub const fn unit(self) -> &'static str {
        match self {
            Self::Paper => "GFLOPs (paper)",
            Self::Macs => "GMACs",
        }
    }
}

impl Macs {
    /// Returns the cost in a convention.
    pub fn count(self, convention: FlopConvention) -> u64 {
        match convention {
            FlopConvention::Paper => self.linear + 5 * self.normalized,
            FlopConvention::Macs => self.linear + self.attention,
        }
    }
}

impl Sum for Macs {
    fn sum<I: Iterator<Item = Self>>(parts: I) -> Self {
        parts.fold(Self::default(), |sum, macs| Self {
            linear: sum.linear + macs.linear,
            attention: sum.attention + macs.attention,
            normalized: sum.normalized + macs.normalized,
        })
    }
}

impl Layer {
    fn macs(&self, sizes: &SceneSizes) -> Macs {
        if self.rows == [Rows::GatheringTokens] && sizes.num_rows(&[Rows::Members]) == 0 {
            return Macs::default();
        }
        let rows = sizes.num_rows(self.rows);
        let pairs = |num_pairs: u64, width: usize| Macs { attention: 2 * num_pairs * width as u64, ..Macs::default() };
        match self.kind {
            LayerKind::Linear { inputs, outputs, .. } => {
                Macs { linear: rows * (inputs * outputs) as u64, ..Macs::default() }
            }
            LayerKind::LayerNorm { width, .. } => Macs { normalized: rows * width as u64, ..Macs::default() },
            LayerKind::Attention { width, keys, .. } => pairs(rows * sizes.group_len(keys), width),
            LayerKind::ClusterAttention { width, keys } => pairs(sizes.num_rows(keys), width),
            LayerKind::HeadNorm { .. } | LayerKind::Activation { .. } | LayerKind::Table { .. } => Macs::default(),
        }
    }
}

impl ModelConfig {
    /// Returns the cost of one network for a scene.
    pub fn macs(&self, part: Part, sizes: &SceneSizes) -> Macs {
        let layers = self.layers();
        layers.iter().filter(|layer| layer.part == part).map(|layer| layer.macs(sizes)).sum()
    }

    /// Returns the cost of rendering one view from `num_render_tokens` tokens: all of its patch grids, and the projection of
    /// keys and values.
    pub fn render_macs(&self, height: usize, width: usize, num_render_tokens: usize) -> Result<Macs, ModelError> {
        self.render_views_macs(height, width, &SceneSizes::new(num_render_tokens, 1, 0))
    }

    /// Returns the cost of rendering the target views of a scene, as [`render_macs`](Self::render_macs). Views share keys and
    /// values as `scene` says; its `num_patches` is not read.
    pub fn render_views_macs(&self, height: usize, width: usize, scene: &SceneSizes) -> Result<Macs, ModelError> {
        let of_patches = |num_patches| self.macs(Part::Renderer, &SceneSizes { num_patches, ..*scene });
        let grids = self.drawn_patches(height, width)?;
        let mut macs: Macs = grids.iter().map(|&num_patches| of_patches(num_patches)).sum();
        // Grids share the keys and values of the tokens.
        let layers = self.layers();
        let of_tokens = layers.iter().filter(|layer| layer.part == Part::Renderer && layer.rows == RENDER_TOKENS);
        macs.linear -= (grids.len() - 1) as u64 * of_tokens.map(|layer| layer.macs(scene).linear).sum::<u64>();
        // The paper counts one norm more than the network has.
        macs.normalized += (scene.num_targets * grids.iter().sum::<usize>() * self.dim) as u64;
        Ok(macs)
    }

    /// Returns the cost of encoding a scene of `num_views` context views.
    pub fn encode_macs(&self, num_views: usize, height: usize, width: usize) -> Result<Macs, ModelError> {
        Ok(self.macs(Part::Encoder, &SceneSizes::of(self, num_views, 0, [height, width])?))
    }

    /// Returns the cost of condensing `num_tokens` tokens into `num_storage_tokens`.
    pub fn condense_macs(&self, num_tokens: usize, num_storage_tokens: usize) -> Macs {
        let num_storage_tokens = Some(num_storage_tokens);
        self.macs(Part::Condenser, &SceneSizes { num_storage_tokens, ..SceneSizes::new(num_tokens, 0, 0) })
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::{DType, Device, Tensor};

    use super::*;
    use crate::network::model::Network;
    use crate::ops::mac_counter;
    use crate::testing::{random, small_configs};
    use crate::tokens::clusters::{Clusters, SceneClusters};
    use crate::views::patch_grids::PatchGrids;
    use crate::views::upload::{Cameras, Views};

    #[test]
    fn paper_convention_gives_the_printed_numbers() {
        let config = ModelConfig::default();
        let printed = [(4096, "70.6", 1), (3072, "63.3", 1), (2048, "56.1", 1), (1024, "48.9", 1), (512, "45.23", 2)];
        for (tokens, expected, decimals) in printed {
            let macs = config.render_macs(256, 256, tokens).unwrap();
            assert_eq!(format!("{:.decimals$}", macs.count(FlopConvention::Paper) as f64 / 1e9), expected);
        }
    }

    #[test]
    fn macs_equal_those_counted_in_a_forward_pass() {
        let device = Device::flex();
        let check = |Macs { linear, attention, .. }: Macs, what: &str| {
            assert_eq!(mac_counter::take(), (linear, attention), "{what}");
        };
        for config in small_configs() {
            let model = Network::new(&config, 0, &device);
            for (num_views, [height, width], stored) in [(2, [16, 24], 5), (3, [8, 16], 1), (4, [24, 8], 6)] {
                let cameras = |views: usize| Cameras {
                    height,
                    width,
                    c2w: Tensor::<2>::eye(4, &device).reshape([1, 1, 4, 4]).expand([1, views, 4, 4]),
                    intrinsics: Tensor::<3>::full([1, views, 4], 9.0, &device),
                };
                let images = random([1, num_views, height, width, 3], 1, &device).cast(DType::F32);
                let num_tokens = config.num_tokens(num_views, height, width).unwrap();
                mac_counter::take();
                let lift = model.encoder.forward(&Views { images, cameras: cameras(num_views) });
                check(config.encode_macs(num_views, height, width).unwrap(), "encoder");

                let assignment = (0..num_tokens as u32).map(|token| token % stored).collect();
                let scene = SceneClusters::new(assignment, (0..stored).collect()).unwrap();
                let whole = SceneClusters::identity(num_tokens);
                let [tokens, _] = [(scene, stored as usize), (whole, num_tokens)].map(|(scene, count)| {
                    let index = Clusters::new(vec![scene]).unwrap().upload(&device);
                    let tokens = model.condenser.forward(lift.clone(), &index);
                    check(config.condense_macs(num_tokens, count), "condenser");
                    tokens
                });
                for tokens in [tokens, lift] {
                    let count = tokens.dims()[1];
                    for patch_grids in [PatchGrids::One, PatchGrids::Two, PatchGrids::Four] {
                        let config = ModelConfig { patch_grids, ..config.clone() };
                        let mut renderer = model.renderer.clone();
                        renderer.set_patch_grids(patch_grids);
                        renderer.render(tokens.clone(), &cameras(1));
                        check(config.render_macs(height, width, count).unwrap(), "one view");
                    }
                    model.renderer.forward(tokens, &cameras(3));
                    let sizes = SceneSizes::new(count, 3, config.num_patches(1, height, width).unwrap());
                    check(config.macs(Part::Renderer, &sizes), "three views");
                }
            }
        }
    }
}
