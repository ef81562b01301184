//! The codec of a model: tokens to words and back.
// N patches of the context views, S tokens, D width

use std::collections::BTreeMap;
use std::path::Path;

use crate::codec::entropy::{Decoder, Encoder, decode_ids, encode_ids};
use crate::codec::histogram::Distributions;
use crate::codec::rates::RateTable;
use crate::codec::table::{MIN_BITS, Table};
use crate::codec::transform::Transform;
use crate::error::ModelError;
use crate::network::config::ModelConfig;
use crate::tokens::kind::TokenKind;
use crate::weights::trained_model::TrainedModel;

/// Squared steps that a bit is worth: the slope of distortion against rate of a fine uniform quantizer, `2 ln 2 / 12`.
const BIT_VALUE: f32 = 0.1155;
/// Largest magnitude of a level.
const MAX_LEVEL: f32 = (1 << 30) as f32;
/// Most values that coded tokens may have: as many as the largest plain file has in f32.
const MAX_VALUES: f64 = (1 << 28) as f64;

/// Transform, probabilities and measured rates of a model's tokens.
#[derive(Clone, Debug, PartialEq)]
pub struct TokenCodec {
    /// Sizes and variant of the network.
    pub model: ModelConfig,
    /// Kind of the tokens.
    pub kind: TokenKind,
    /// Hash of the renderer, see [`TrainedModel::renderer_hash`](crate::TrainedModel::renderer_hash).
    pub renderer_hash: String,
    /// The transform.
    pub transform: Transform,
    /// The distribution of every coefficient.
    pub distributions: Distributions,
    /// Measured bits and losses.
    pub rates: RateTable,
    /// First 16 hexadecimal digits of the SHA-256 of the codec's file, which scene files contain.
    pub hash: String,
}

/// Tokens as integers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Levels {
    /// Of every direction the levels of all tokens, `[D][S]`.
    pub of_direction: Vec<Vec<i32>>,
    pub num_tokens: usize,
}

/// Counts of the levels of every direction.
#[derive(Clone, Debug, Default)]
pub struct LevelCounts(BTreeMap<(usize, i32), u64>);

impl LevelCounts {
    /// Returns the bits of all counted levels by their entropy, the bound of every coder that codes a level by its
    /// direction alone.
    pub fn entropy_bits(&self) -> f64 {
        let mut totals = BTreeMap::<usize, u64>::new();
        for (&(direction, _), count) in &self.0 {
            *totals.entry(direction).or_default() += count;
        }
        let bits = |(&(direction, _), &count): (&(usize, i32), &u64)| {
            count as f64 * (totals[&direction] as f64 / count as f64).log2()
        };
        self.0.iter().map(bits).sum()
    }
}

impl TokenCodec {
    /// Reads the codec beside the weights of a model; `None` without a codec.
    ///
    /// # Errors
    /// As [`read`](Self::read), and [`ModelError::CodecFile`] for a codec of other weights.
    pub fn beside(weights: &Path, model: &TrainedModel) -> Result<Option<Self>, ModelError> {
        let path = Self::path_of(weights);
        if !path.exists() {
            return Ok(None);
        }
        let codec = Self::read(&path)?;
        if codec.renderer_hash == model.renderer_hash() {
            return Ok(Some(codec));
        }
        let reason = "the codec was fitted to other weights".into();
        Err(ModelError::CodecFile { action: "reading", reason, path })
    }

    /// Rounds tokens `[S, D]` to coefficients of whole `step`s, as writing and reading a file does.
    ///
    /// # Errors
    /// [`ModelError::BadConfig`] for a step that is not positive, or too small for the tokens.
    pub fn round(&self, tokens: &[f32], step: f32) -> Result<Vec<f32>, ModelError> {
        let levels = self.quantize(tokens, step)?;
        Ok(self.dequantize(&levels, step))
    }

    /// Returns the bits of tokens `[S, D]` in a stream of their own, and counts their levels.
    ///
    /// # Errors
    /// As [`round`](Self::round).
    pub fn count_bits(&self, tokens: &[f32], step: f32, counts: &mut LevelCounts) -> Result<f64, ModelError> {
        let levels = self.quantize(tokens, step)?;
        for (direction, levels) in levels.of_direction.iter().enumerate() {
            for &level in levels {
                *counts.0.entry((direction, level)).or_default() += 1;
            }
        }
        let mut encoder = Encoder::default();
        self.encode_levels(&levels, step, &mut encoder);
        Ok(encoder.finish().len() as f64 * 32.0)
    }

    /// Encodes tokens `[S, D]` of ascending `ids`, patches below `num_patches`.
    ///
    /// # Errors
    /// As [`round`](Self::round).
    pub fn encode(&self, tokens: &[f32], ids: &[u32], num_patches: usize, step: f32) -> Result<Vec<u32>, ModelError> {
        let levels = self.quantize(tokens, step)?;
        let mut encoder = Encoder::default();
        encode_ids(&mut encoder, ids, num_patches);
        self.encode_levels(&levels, step, &mut encoder);
        Ok(encoder.finish())
    }

    /// Decodes tokens and their ids, which may be damaged or hostile: memory is bounded by the number of words, and by
    /// `MAX_VALUES`.
    ///
    /// # Errors
    /// The problem of words that no encoder writes.
    pub fn decode(
        &self,
        words: Vec<u32>,
        num_tokens: usize,
        num_patches: usize,
        step: f32,
    ) -> Result<(Vec<u32>, Vec<f32>), String> {
        if !(1..=num_patches).contains(&num_tokens) {
            return Err(format!("{num_tokens} tokens, expected 1 to {num_patches}, the number of patches"));
        }
        check_step(step)?;
        let dim = self.transform.mean.len();
        let most = ((words.len() as f64 + 1.0) * 32.0 / MIN_BITS).min(MAX_VALUES);
        if num_tokens as f64 * dim as f64 > most {
            return Err(format!(
                "{num_tokens} tokens of width {dim} in {} words, expected at most {most:.0} values",
                words.len()
            ));
        }
        let mut decoder = Decoder::new(words).ok_or("the last word of the tokens is 0")?;
        let ids = decode_ids(&mut decoder, num_tokens, num_patches);
        let mut of_direction = Vec::with_capacity(dim);
        for direction in 0..dim {
            let table = self.table(direction, step);
            let levels: Option<Vec<i32>> = (0..num_tokens).map(|_| table.decode(&mut decoder)).collect();
            of_direction.push(levels.ok_or("a coded value has more bits than any value")?);
        }
        if !decoder.is_finished() {
            return Err("words are left after the last token".into());
        }
        Ok((ids, self.dequantize(&Levels { of_direction, num_tokens }, step)))
    }

    fn table(&self, direction: usize, step: f32) -> Table {
        let Distributions { knots, cumulative } = &self.distributions;
        let cumulative = &cumulative[direction * knots.len()..][..knots.len()];
        Table::new(knots, cumulative, f64::from(step) / f64::from(self.transform.deviations[direction]))
    }

    /// Rounds every coefficient to the level of the least cost: squared error, and bits at [`BIT_VALUE`].
    fn quantize(&self, tokens: &[f32], step: f32) -> Result<Levels, ModelError> {
        let bad = |fix| ModelError::BadConfig { key: "step", value: step.to_string(), fix };
        check_step(step).map_err(|reason| bad(format!("{reason}; write a positive number")))?;
        let dim = self.transform.mean.len();
        let num_tokens = tokens.len() / dim;
        let coefficients = self.transform.forward(tokens);
        let mut of_direction = Vec::with_capacity(dim);
        for direction in 0..dim {
            let table = self.table(direction, step);
            let mut levels = Vec::with_capacity(num_tokens);
            for token in 0..num_tokens {
                let value = coefficients[token * dim + direction] / step;
                // A coefficient may be NaN after an overflow.
                if value.is_nan() || value.abs() >= MAX_LEVEL {
                    let fix = format!("token {token} has a coefficient of {value} steps; write a larger step, or f32");
                    return Err(bad(fix));
                }
                levels.push(cheapest_level(value, &table));
            }
            of_direction.push(levels);
        }
        Ok(Levels { of_direction, num_tokens })
    }

    fn dequantize(&self, levels: &Levels, step: f32) -> Vec<f32> {
        self.transform.inverse(&levels.of_direction, step, levels.num_tokens)
    }

    fn encode_levels(&self, levels: &Levels, step: f32, encoder: &mut Encoder) {
        for (direction, levels) in levels.of_direction.iter().enumerate() {
            let table = self.table(direction, step);
            for &level in levels {
                table.encode(level, encoder);
            }
        }
    }
}

fn check_step(step: f32) -> Result<(), String> {
    if step.is_normal() && step > 0.0 { Ok(()) } else { Err(format!("step {step}")) }
}

fn cheapest_level(value: f32, table: &Table) -> i32 {
    let nearest = value.round() as i32;
    if nearest == 0 {
        return 0;
    }
    let cost = |level: i32| (value - level as f32).powi(2) + BIT_VALUE * table.bits(level);
    let smaller = nearest - nearest.signum();
    if cost(smaller) < cost(nearest) { smaller } else { nearest }
}

#[cfg(test)]
pub(crate) mod tests;
