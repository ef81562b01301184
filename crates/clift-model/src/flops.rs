//! What the networks cost, by their sizes alone: multiply-accumulates, and the paper's way of counting them.
// N tokens, S stored, R rendered, Q patches of a view, D width, F feed-forward width, L blocks

use std::str::FromStr;

use strum::{Display, IntoStaticStr, VariantArray};

use crate::names::parse_value;
use crate::{ModelConfig, ModelError};

/// Multiply-accumulates of a forward pass of one scene. Norms, activations, softmax and the rays of pixels are not
/// counted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Macs {
    /// Of linear layers.
    pub linear: u64,
    /// Of scores (`Q K^T`) and weighted sums (`A V`).
    pub attention: u64,
    /// Values that layer norms normalise.
    pub normalised: u64,
}

/// How an amount of work is told.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Display, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "lowercase")]
pub enum Convention {
    /// As the paper's numbers come out (render-budget table): one per multiply-accumulate of linear layers, attention
    /// left out, and five per value of `3 L + 2` layer norms. The first two are what fvcore counts where attention is
    /// one fused operation; the number of norms is fitted to the five printed values (`3 L + 1` are there).
    Paper,
    /// Multiply-accumulates, attention included.
    #[default]
    Macs,
    /// Floating-point operations: two per multiply-accumulate, attention included.
    Flops,
}

impl Convention {
    /// All conventions.
    pub const ALL: [Self; 3] = *Self::VARIANTS.as_array().expect("three variants");

    /// Returns the name as it is typed.
    pub fn name(self) -> &'static str {
        self.into()
    }

    /// The unit of a thousand million of it.
    pub const fn unit(self) -> &'static str {
        match self {
            Self::Paper => "GFLOPs (paper)",
            Self::Macs => "GMACs",
            Self::Flops => "GFLOPs",
        }
    }
}

impl FromStr for Convention {
    type Err = ModelError;

    fn from_str(name: &str) -> Result<Self, ModelError> {
        parse_value("convention", name)
    }
}

impl Macs {
    /// The amount of work in a convention.
    pub fn count(self, convention: Convention) -> u64 {
        match convention {
            Convention::Paper => self.linear + 5 * self.normalised,
            Convention::Macs => self.linear + self.attention,
            Convention::Flops => 2 * (self.linear + self.attention),
        }
    }
}

impl ModelConfig {
    /// Work of drawing one view alone from `num_render_tokens` tokens, their keys and values included.
    ///
    /// # Errors
    /// [`ModelError::NotDivisible`] when a side is not a positive multiple of the patch.
    pub fn render_macs(&self, height: usize, width: usize, num_render_tokens: usize) -> Result<Macs, ModelError> {
        let queries = self.num_tokens(1, height, width)? as u64;
        let [tokens, dim, hidden, blocks] =
            [num_render_tokens, self.dim, self.feed_forward_dim, self.num_renderer_blocks].map(|size| size as u64);
        let square = dim * dim;
        // Query, key, value and output of the views' own patches; query and output, then key and value of the tokens.
        let per_block = 4 * queries * square + 2 * queries * square + 2 * tokens * square + 2 * queries * dim * hidden;
        let ends = queries * dim * (self.ray_patch_len() + self.rgb_patch_len()) as u64;
        Ok(Macs {
            linear: blocks * per_block + ends,
            attention: blocks * (2 * queries * queries * dim + 2 * queries * tokens * dim),
            normalised: (3 * blocks + 2) * queries * dim,
        })
    }

    /// Work of encoding a scene of so many context views.
    ///
    /// # Errors
    /// [`ModelError::NotDivisible`] when a side is not a positive multiple of the patch.
    pub fn encode_macs(&self, num_views: usize, height: usize, width: usize) -> Result<Macs, ModelError> {
        let tokens = self.num_tokens(num_views, height, width)? as u64;
        let [dim, hidden, blocks] = [self.dim, self.feed_forward_dim, self.num_encoder_blocks].map(|size| size as u64);
        Ok(Macs {
            linear: blocks * (4 * tokens * dim * dim + 2 * tokens * dim * hidden)
                + tokens * dim * self.context_patch_len() as u64,
            attention: blocks * 2 * tokens * tokens * dim,
            normalised: 2 * blocks * tokens * dim,
        })
    }

    /// Work of condensing `num_tokens` tokens into `num_storage_tokens`: every other token is a key of its own
    /// centroid.
    pub fn condense_macs(&self, num_tokens: usize, num_storage_tokens: usize) -> Macs {
        // In the released networks a centroid is a key of itself.
        let is_released = self.variant.is_released();
        let num_keys = if is_released { num_tokens } else { num_tokens.saturating_sub(num_storage_tokens) };
        let [stored, keys, dim, hidden, blocks] =
            [num_storage_tokens, num_keys, self.dim, self.feed_forward_dim, self.condenser.num_blocks]
                .map(|size| size as u64);
        let square = dim * dim;
        // Without keys equation 2 is skipped, its projections too.
        let cross = if keys > 0 { 2 * stored * square + 2 * keys * square } else { 0 };
        Macs {
            linear: blocks * (4 * stored * square + cross + 2 * stored * dim * hidden + stored * square),
            attention: blocks * (2 * stored * stored * dim + 2 * keys * dim),
            normalised: blocks * (3 * stored + if is_released { 0 } else { keys }) * dim,
        }
    }
}

/// In tests: multiply-accumulates that really ran on this thread, counted where layers and attention begin.
#[cfg(not(test))]
pub(crate) mod counted {
    /// A product of `rows` rows of `inputs` values by a matrix of `outputs` columns.
    pub const fn add_linear(_rows: usize, _inputs: usize, _outputs: usize) {}

    /// Scores and weighted sums of so many pairs of a query and a key, over all heads together of width `dim`.
    pub const fn add_attention(_pairs: usize, _dim: usize) {}
}

/// In tests: multiply-accumulates that really ran on this thread, counted where layers and attention begin.
#[cfg(test)]
pub(crate) mod counted {
    use std::cell::Cell;

    thread_local! {
        static LINEAR: Cell<u64> = const { Cell::new(0) };
        static ATTENTION: Cell<u64> = const { Cell::new(0) };
    }

    /// A product of `rows` rows of `inputs` values by a matrix of `outputs` columns.
    pub fn add_linear(rows: usize, inputs: usize, outputs: usize) {
        LINEAR.set(LINEAR.get() + (rows * inputs * outputs) as u64);
    }

    /// Scores and weighted sums of so many pairs of a query and a key, over all heads together of width `dim`.
    pub fn add_attention(pairs: usize, dim: usize) {
        ATTENTION.set(ATTENTION.get() + (2 * pairs * dim) as u64);
    }

    /// What was counted since the last call: linear layers, attention.
    pub fn take() -> (u64, u64) {
        (LINEAR.take(), ATTENTION.take())
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::{DType, Device, Tensor};

    use super::*;
    use crate::testing::random;
    use crate::{Cameras, Clift, Clusters, SceneClusters, Views};

    #[test]
    fn the_papers_numbers_come_out_to_the_printed_digits() {
        let config = ModelConfig::default();
        let printed = [(4096, "70.6", 1), (3072, "63.3", 1), (2048, "56.1", 1), (1024, "48.9", 1), (512, "45.23", 2)];
        for (tokens, expected, decimals) in printed {
            let macs = config.render_macs(256, 256, tokens).unwrap();
            assert_eq!(format!("{:.decimals$}", macs.count(Convention::Paper) as f64 / 1e9), expected);
        }
    }

    #[test]
    fn the_full_size_networks_cost_what_the_formulas_say() {
        let config = ModelConfig::default();
        for tokens in [4096_u64, 512, 1] {
            let macs = config.render_macs(256, 256, tokens as usize).unwrap();
            assert_eq!(macs.linear, 41_523_609_600 + 7_077_888 * tokens);
            assert_eq!(macs.attention, 9_663_676_416 + 9_437_184 * tokens);
            assert_eq!(macs.count(Convention::Flops), 2 * macs.count(Convention::Macs));
        }
        let giga = |macs: Macs| (macs.count(Convention::Macs) as f64 / 1e8).round() / 10.0;
        assert_eq!(giga(config.render_macs(256, 448, 7168).unwrap()), 271.4);
        assert_eq!(giga(config.encode_macs(4, 256, 256).unwrap()), 291.7);
        assert!(config.render_macs(250, 256, 1).is_err());
    }

    /// What a network really multiplies, against the formula.
    #[test]
    fn a_real_forward_multiplies_as_often_as_convention_macs_says() {
        let device = Device::flex();
        for (residual, num_views, [height, width], stored) in
            [(true, 2, [16, 24], 5), (false, 3, [8, 16], 1), (true, 2, [24, 8], 6)]
        {
            let mut config = ModelConfig {
                dim: 24,
                num_heads: 3,
                feed_forward_dim: 40,
                num_encoder_blocks: 3,
                num_renderer_blocks: 2,
                ..ModelConfig::default()
            };
            config.condenser.residual = residual;
            let model = Clift::new(&config, 0, &device);
            let cameras = |views: usize| Cameras {
                height,
                width,
                c2w: Tensor::<2>::eye(4, &device).reshape([1, 1, 4, 4]).expand([1, views, 4, 4]),
                intrinsics: Tensor::<1>::from_floats([9.0, 9.0, 8.0, 8.0], &device)
                    .reshape([1, 1, 4])
                    .expand([1, views, 4]),
            };
            let images = random([1, num_views, height, width, 3], 1, &device).cast(DType::F32);
            let num_tokens = config.num_tokens(num_views, height, width).unwrap();

            counted::take();
            let lift = model.encoder.forward(&Views { images, cameras: cameras(num_views) });
            let expected = config.encode_macs(num_views, height, width).unwrap();
            assert_eq!(counted::take(), (expected.linear, expected.attention), "encoder");

            let assignment = (0..num_tokens as u32).map(|token| token % stored).collect();
            let scene = SceneClusters::new(assignment, (0..stored).collect()).unwrap();
            let index = Clusters::new(vec![scene]).unwrap().upload(&device);
            let tokens = model.condenser.forward(lift.clone(), &index);
            let expected = config.condense_macs(num_tokens, stored as usize);
            assert_eq!(counted::take(), (expected.linear, expected.attention), "condenser");

            for tokens in [tokens, lift] {
                let count = tokens.dims()[1];
                let expected = config.render_macs(height, width, count).unwrap();
                model.renderer.forward(tokens.clone(), &cameras(1));
                assert_eq!(counted::take(), (expected.linear, expected.attention), "renderer, {count} tokens");
                model.renderer.draw(&model.renderer.memory(&tokens), &cameras(1));
                assert_eq!(counted::take(), (expected.linear, expected.attention), "prepared, {count} tokens");
            }
            let whole = SceneClusters::identity(num_tokens);
            model.condenser.forward(
                random([1, num_tokens, 24], 2, &device).cast(DType::F32),
                &Clusters::new(vec![whole]).unwrap().upload(&device),
            );
            let expected = config.condense_macs(num_tokens, num_tokens);
            assert_eq!(counted::take(), (expected.linear, expected.attention), "every token its own cluster");
        }
    }
}
