//! The tokens of target views, and the cached keys and values of a scene.

use burn::tensor::{Int, Tensor, TensorData};

use crate::network::blocks::block::DecoderBlock;
use crate::network::tokens::{Tokens, select};

/// Input of the renderer's blocks from a scene, the same for all of its views.
#[derive(Clone, Debug)]
#[expect(clippy::large_enum_variant, reason = "a scene has one cache")]
pub enum KeyValueCache {
    /// The tokens themselves.
    Tokens(RenderTokens),
    /// Keys and values of the tokens, `[batch, num_tokens, 2 dim]` per block.
    Projected(Vec<Tensor<3>>),
}

impl KeyValueCache {
    /// Returns the tokens of every set, `[groups, num_tokens, dim]`.
    pub(crate) fn sets(&self) -> Tensor<3> {
        match self {
            Self::Tokens(tokens) => tokens.sets(),
            Self::Projected(_) => panic!("the renderer reads tokens, not their keys and values"),
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
            Self::Projected(blocks) => Self::Projected(blocks.iter().map(|rows| select(rows.clone(), ids)).collect()),
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
        let rows = TensorData::new(rows, [groups, count / groups]);
        let rows = Tensor::<2, Int>::from_data(rows, &tokens.values.device());
        // Keys and values are projected from whichever has fewer rows: the tokens, or all subsets together.
        if count < batch * num_tokens {
            tokens.map(|x| gather(x, Some(&rows))).into()
        } else {
            Self { tokens, rows: Some(rows) }
        }
    }

    /// Returns the values of the tokens that keys and values are projected from.
    pub fn values(&self) -> &Tensor<3> {
        &self.tokens.values
    }

    pub(crate) fn has_transforms(&self) -> bool {
        self.tokens.transforms.is_some()
    }

    /// Returns the tokens of every set, `[groups, num_render_tokens, dim]`.
    pub(crate) fn sets(&self) -> Tensor<3> {
        gather(self.tokens.values.clone(), self.rows.as_ref())
    }

    /// Projects the keys and values of every set for a block, `[groups, num_render_tokens, 2 dim]`.
    pub fn project(&self, block: &DecoderBlock) -> Tensor<3> {
        gather(block.project_tokens(self.tokens.clone()), self.rows.as_ref())
    }
}

/// `[B, N, D]`, rows `[G, R]` of `[BN, D] -> [G, R, D]`; all of `[B, N, D]` without rows
fn gather(x: Tensor<3>, rows: Option<&Tensor<2, Int>>) -> Tensor<3> {
    let Some(rows) = rows else { return x };
    let ([batch, count, dim], [groups, kept]) = (x.dims(), rows.dims());
    x.reshape([batch * count, dim]).select(0, rows.clone().reshape([groups * kept])).reshape([groups, kept, dim])
}
