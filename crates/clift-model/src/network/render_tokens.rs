//! Tokens per view; cached keys and values.

use burn::tensor::{Int, Tensor, TensorData};

use crate::network::blocks::block::DecoderBlock;

/// Keys and values of a scene's tokens in every block of a renderer.
#[derive(Clone, Debug)]
pub struct KeyValueCache {
    /// Each `[batch, num_render_tokens, 2 dim]`.
    pub(crate) blocks: Vec<Tensor<3>>,
    pub(crate) num_render_tokens: usize,
}

impl KeyValueCache {
    /// How many tokens it is of.
    pub fn num_render_tokens(&self) -> usize {
        self.num_render_tokens
    }

    /// The memory of some of the tokens, by their places.
    #[must_use]
    pub fn select(&self, tokens: &[u32]) -> Self {
        let Some(first) = self.blocks.first() else {
            return self.clone();
        };
        let places: Vec<i64> = tokens.iter().map(|&token| i64::from(token)).collect();
        let places = Tensor::<1, Int>::from_data(TensorData::new(places, [tokens.len()]), &first.device());
        let blocks = self.blocks.iter().map(|memory| memory.clone().select(1, places.clone())).collect();
        Self { blocks, num_render_tokens: tokens.len() }
    }
}

/// The tokens that target views are drawn from.
#[derive(Clone, Debug)]
pub struct RenderTokens {
    /// `[batch, num_tokens, dim]`
    tokens: Tensor<3>,
    /// Where every target view has a set of its own: its rows among the tokens of all scenes, `[groups, R]`.
    rows: Option<Tensor<2, Int>>,
}

impl From<Tensor<3>> for RenderTokens {
    /// One set per scene, `[batch, num_render_tokens, dim]`, or per target view, `[batch * views, ..]`.
    fn from(tokens: Tensor<3>) -> Self {
        Self { tokens, rows: None }
    }
}

impl RenderTokens {
    /// For every target view of every scene its own equally large subset of the scene's tokens:
    /// `subsets[scene][view]` are token ids.
    ///
    /// # Shapes
    /// - `tokens`: `[batch, num_tokens, dim]`
    pub fn subsets(tokens: Tensor<3>, subsets: &[Vec<Vec<u32>>]) -> Self {
        let [batch, num_tokens, _dim] = tokens.dims();
        let groups: usize = subsets.iter().map(Vec::len).sum();
        let rows: Vec<i64> = subsets
            .iter()
            .enumerate()
            .flat_map(|(scene, views)| views.iter().flatten().map(move |&token| (scene, token)))
            .map(|(scene, token)| (scene * num_tokens) as i64 + i64::from(token))
            .collect();
        let count = rows.len();
        let rows = Tensor::<1, Int>::from_data(TensorData::new(rows, [count]), &tokens.device());
        let rows = rows.reshape([groups, count / groups]);
        // Keys and values are projected for what there is less of: the tokens, or the subsets together.
        if count < batch * num_tokens { gather(tokens, rows).into() } else { Self { tokens, rows: Some(rows) } }
    }

    /// The same sets of other tokens in the same places, on the tape where those are.
    #[must_use]
    pub fn with_tokens(&self, tokens: Tensor<3>) -> Self {
        let rows = self.rows.clone().map(|rows| if tokens.is_autodiff() { rows.autodiff() } else { rows });
        Self { tokens, rows }
    }

    /// The tokens that keys and values are projected from.
    pub fn tokens(&self) -> &Tensor<3> {
        &self.tokens
    }

    /// Keys and values of every set, `[groups, num_render_tokens, 2 dim]`.
    pub fn memory(&self, block: &DecoderBlock) -> Tensor<3> {
        let memory = block.memory(self.tokens.clone());
        match &self.rows {
            Some(rows) => gather(memory, rows.clone()),
            None => memory,
        }
    }
}

/// `[B, N, D]`, rows `[G, R]` of `[BN, D] -> [G, R, D]`
fn gather(x: Tensor<3>, rows: Tensor<2, Int>) -> Tensor<3> {
    let ([batch, count, dim], [groups, kept]) = (x.dims(), rows.dims());
    x.reshape([batch * count, dim]).select(0, rows.reshape([groups * kept])).reshape([groups, kept, dim])
}
