//! The tokens of target views, and the cached keys and values of a scene.

use burn::tensor::{Int, Tensor, TensorData};

use crate::network::blocks::block::DecoderBlock;
use crate::network::camera_encoding::upload_ids;
use crate::network::tokens::Tokens;

/// Input of the renderer's blocks from a scene, the same for all of its views.
#[derive(Clone, Debug)]
#[expect(clippy::large_enum_variant, reason = "a scene has one cache")]
pub enum KeyValueCache {
    /// The tokens themselves.
    Tokens(RenderTokens),
    /// Keys and values of the tokens.
    Projected {
        /// One tensor per block, `[batch, num_tokens, 2 dim]`.
        blocks: Vec<Tensor<3>>,
        /// Number of tokens.
        num_tokens: usize,
    },
}

impl KeyValueCache {
    /// Returns the number of tokens of every set.
    pub fn num_tokens(&self) -> usize {
        match self {
            Self::Tokens(tokens) => tokens.num_tokens(),
            Self::Projected { num_tokens, .. } => *num_tokens,
        }
    }

    /// Returns the tokens of every set, `[groups, num_tokens, dim]`.
    ///
    /// # Panics
    /// For projected tokens.
    pub(crate) fn sets(&self) -> Tensor<3> {
        match self {
            Self::Tokens(tokens) => tokens.sets(),
            Self::Projected { .. } => panic!("the renderer reads tokens, not their keys and values"),
        }
    }

    /// Selects the same tokens of every scene, given by their indices.
    ///
    /// # Panics
    /// If every target view has its own tokens.
    #[must_use]
    pub fn select(&self, ids: &[u32]) -> Self {
        match self {
            Self::Tokens(RenderTokens { tokens, rows }) => {
                assert!(rows.is_none(), "one set of tokens per scene");
                Self::Tokens(tokens.select(ids).into())
            }
            Self::Projected { blocks, .. } => {
                let select = |key_value: &Tensor<3>| key_value.clone().select(1, upload_ids(ids, &key_value.device()));
                Self::Projected { blocks: blocks.iter().map(select).collect(), num_tokens: ids.len() }
            }
        }
    }
}

/// The tokens from which target views are rendered.
#[derive(Clone, Debug)]
pub struct RenderTokens {
    tokens: Tokens,
    /// With one token set per target view: the rows of each set in the tokens of all scenes, `[groups, R]`.
    rows: Option<Tensor<2, Int>>,
}

impl From<Tokens> for RenderTokens {
    /// Takes one set per scene, `[batch, num_render_tokens, dim]`, or per target view, `[batch * views, ..]`.
    fn from(tokens: Tokens) -> Self {
        Self { tokens, rows: None }
    }
}

impl RenderTokens {
    /// Selects a subset of the scene's tokens for every target view; all subsets have the same size.
    /// `subsets[scene][view]` are token indices.
    ///
    /// # Shapes
    /// - `tokens`: `[batch, num_tokens, dim]`
    pub fn subsets(tokens: Tokens, subsets: &[Vec<Vec<u32>>]) -> Self {
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
    pub(crate) fn num_tokens(&self) -> usize {
        self.rows.as_ref().map_or(self.tokens.dims()[1], |rows| rows.dims()[1])
    }

    /// Whether the tokens have the transforms of camera-relative attention.
    pub(crate) fn has_transforms(&self) -> bool {
        self.tokens.transforms.is_some()
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
