//! The tokens of target views, and the cached keys and values of a scene.

use burn::tensor::{Int, Tensor, TensorData};

use crate::network::blocks::block::DecoderBlock;
use crate::network::camera_encoding::upload_ids;
use crate::network::tokens::Tokens;

/// Keys and values of a scene's tokens in every block of a renderer; the tokens themselves for LVSM's, which mixes them with
/// the patches of every view.
#[derive(Clone, Debug)]
pub struct KeyValueCache {
    /// One tensor per block, `[batch, num_render_tokens, 2 dim]`.
    pub(crate) blocks: Vec<Tensor<3>>,
    pub(crate) tokens: Option<RenderTokens>,
    pub(crate) num_render_tokens: usize,
}

impl KeyValueCache {
    /// Returns the keys and values of some tokens, given by their indices.
    #[must_use]
    pub fn select(&self, tokens: &[u32]) -> Self {
        let Some(first) = self.blocks.first() else {
            return self.clone();
        };
        let indices = upload_ids(tokens, &first.device());
        let blocks = self.blocks.iter().map(|key_value| key_value.clone().select(1, indices.clone())).collect();
        Self { blocks, tokens: None, num_render_tokens: tokens.len() }
    }
}

/// The tokens from which target views are rendered.
#[derive(Clone, Debug)]
pub struct RenderTokens {
    tokens: Tokens,
    /// With one token set per target view: the rows of each set in the tokens of all scenes, `[groups, R]`.
    rows: Option<Tensor<2, Int>>,
}

impl<T: Into<Tokens>> From<T> for RenderTokens {
    /// Takes one set per scene, `[batch, num_render_tokens, dim]`, or per target view, `[batch * views, ..]`.
    fn from(tokens: T) -> Self {
        Self { tokens: tokens.into(), rows: None }
    }
}

impl RenderTokens {
    /// Selects a subset of the scene's tokens for every target view; all subsets have the same size.
    /// `subsets[scene][view]` are token indices.
    ///
    /// # Shapes
    /// - `tokens`: `[batch, num_tokens, dim]`
    pub fn subsets(tokens: impl Into<Tokens>, subsets: &[Vec<Vec<u32>>]) -> Self {
        let tokens = tokens.into();
        let [batch, num_tokens, _dim] = tokens.dims();
        let groups: usize = subsets.iter().map(Vec::len).sum();
        let rows: Vec<i64> = subsets
            .iter()
            .enumerate()
            .flat_map(|(scene, views)| views.iter().flatten().map(move |&token| (scene, token)))
            .map(|(scene, token)| (scene * num_tokens) as i64 + i64::from(token))
            .collect();
        let count = rows.len();
        let rows = Tensor::<1, Int>::from_data(TensorData::new(rows, [count]), &tokens.values.device());
        let rows = rows.reshape([groups, count / groups]);
        // Keys and values are projected from whichever has fewer rows: the tokens, or all subsets together.
        if count < batch * num_tokens {
            let transforms = tokens.transforms.as_ref();
            let transforms = transforms.map(|transforms| transforms.gather(rows.clone().reshape([count]), groups));
            Tokens { values: gather(tokens.values, rows), transforms }.into()
        } else {
            Self { tokens, rows: Some(rows) }
        }
    }

    /// Returns the same sets of tokens with other values, tracked by autodiff if `values` are.
    #[must_use]
    pub fn with_values(&self, values: Tensor<3>) -> Self {
        let rows = self.rows.clone().map(|rows| if values.is_autodiff() { rows.autodiff() } else { rows });
        Self { tokens: self.tokens.with_values(values), rows }
    }

    /// Returns the values of the tokens that keys and values are projected from.
    pub fn values(&self) -> &Tensor<3> {
        &self.tokens.values
    }

    /// Returns the number of tokens of every set.
    pub(crate) fn num_render_tokens(&self) -> usize {
        self.rows.as_ref().map_or(self.tokens.dims()[1], |rows| rows.dims()[1])
    }

    /// Returns the tokens of every set, `[groups, num_render_tokens, dim]`.
    pub(crate) fn sets(&self) -> Tensor<3> {
        match &self.rows {
            Some(rows) => gather(self.tokens.values.clone(), rows.clone()),
            None => self.tokens.values.clone(),
        }
    }

    /// Projects the keys and values of every set for a block, `[groups, num_render_tokens, 2 dim]`.
    pub fn project(&self, block: &DecoderBlock) -> Tensor<3> {
        let key_value = block.project_tokens(self.tokens.clone());
        match &self.rows {
            Some(rows) => gather(key_value, rows.clone()),
            None => key_value,
        }
    }
}

/// `[B, N, D]`, rows `[G, R]` of `[BN, D] -> [G, R, D]`
fn gather(x: Tensor<3>, rows: Tensor<2, Int>) -> Tensor<3> {
    let ([batch, count, dim], [groups, kept]) = (x.dims(), rows.dims());
    x.reshape([batch * count, dim]).select(0, rows.reshape([groups * kept])).reshape([groups, kept, dim])
}
