//! The codec of a model: tokens to words and back.
// N patches of the context views, S tokens, D width

use std::path::Path;

use clift_model::{ModelConfig, ModelError, TokenKind, TrainedModel};

use crate::codec::entropy::{Decoder, Encoder, decode_ids, encode_ids};
use crate::codec::histogram::Distributions;
use crate::codec::prediction::{NUM_CLASSES, Neighbours, Places, Prediction, neighbours};
use crate::codec::rates::RateTable;
use crate::codec::table::{MIN_BITS, Table};
use crate::codec::transform::Transform;

/// Squared steps that a bit is worth: the slope of distortion against rate of a fine uniform quantizer, `2 ln 2 / 12`.
const BIT_VALUE: f32 = 0.1155;
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
    /// Hash of the renderer, see [`TrainedModel::renderer_hash`](clift_model::TrainedModel::renderer_hash).
    pub renderer_hash: String,
    /// The transform.
    pub transform: Transform,
    /// Prediction of coefficients from neighbouring tokens.
    pub prediction: Prediction,
    /// The distribution of every coefficient around its expected value.
    pub distributions: Distributions,
    /// Measured losses.
    pub rates: RateTable,
    /// First 16 hexadecimal digits of the SHA-256 of the codec's file, which scene files contain.
    pub hash: String,
}

impl TokenCodec {
    /// Reads the codec beside the weights of a model; `None` without a codec.
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
    pub fn round(&self, tokens: &[f32], places: Places<'_>, step: f32) -> Result<Vec<f32>, ModelError> {
        let levels = self.quantize(tokens, places, step)?.0;
        let dim = self.transform.mean.len();
        let sorted = self.transform.inverse(&levels, step, tokens.len() / dim);
        let mut rounded = vec![0.0; tokens.len()];
        for (row, token) in sorted.chunks_exact(dim).zip(places.order()) {
            rounded[token * dim..(token + 1) * dim].copy_from_slice(row);
        }
        Ok(rounded)
    }

    /// Encodes tokens `[S, D]` and their places, in the order of ids.
    pub fn encode(&self, tokens: &[f32], places: Places<'_>, step: f32) -> Result<Vec<u32>, ModelError> {
        let mut ids = places.ids.to_vec();
        ids.sort_unstable();
        let mut encoder = Encoder::default();
        encode_ids(&mut encoder, &ids, places.grid.iter().product());
        let (levels, neighbours) = self.quantize(tokens, places, step)?;
        for (direction, levels) in levels.iter().enumerate() {
            let tables = self.tables(direction, &neighbours, step);
            for (level, &(class, nearest)) in levels.iter().zip(&neighbours) {
                let expected = self.prediction.level(class, direction, nearest.map(|token| levels[token]));
                tables[class].encode(level - expected, &mut encoder);
            }
        }
        Ok(encoder.finish())
    }

    /// Decodes tokens and their ids on a `grid` of views, rows and columns. Words may be damaged or hostile: memory is
    /// bounded by their number, and by `MAX_VALUES`.
    pub fn decode(
        &self,
        words: Vec<u32>,
        num_tokens: usize,
        grid: [usize; 3],
        step: f32,
    ) -> Result<(Vec<u32>, Vec<f32>), String> {
        let num_patches = grid.iter().product();
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
        let neighbours = neighbours(&ids, grid);
        for direction in 0..dim {
            let tables = self.tables(direction, &neighbours, step);
            let mut levels = vec![0; num_tokens];
            for (token, &(class, nearest)) in neighbours.iter().enumerate() {
                let expected = self.prediction.level(class, direction, nearest.map(|token| levels[token]));
                let level = tables[class].decode(&mut decoder).and_then(|deviation| deviation.checked_add(expected));
                levels[token] = level.ok_or("a coded value has more bits than any value")?;
            }
            of_direction.push(levels);
        }
        if !decoder.is_finished() {
            return Err("words are left after the last token".into());
        }
        Ok((ids, self.transform.inverse(&of_direction, step, num_tokens)))
    }

    /// Returns the table of every class; an empty one for a class without tokens.
    fn tables(&self, direction: usize, neighbours: &[(usize, [usize; 2])], step: f32) -> [Table; NUM_CLASSES] {
        let Distributions { knots, cumulative } = &self.distributions;
        let cumulative = &cumulative[direction * knots.len()..][..knots.len()];
        let step = f64::from(step) / f64::from(self.transform.deviations[direction]);
        std::array::from_fn(|class| {
            let deviation = self.prediction.deviation(class, direction, step);
            let has_class = neighbours.iter().any(|(found, _)| *found == class);
            if has_class { Table::new(knots, cumulative, step / deviation) } else { Table::default() }
        })
    }

    /// Rounds every coefficient to the level of the least cost: squared error, and bits at [`BIT_VALUE`]. Returns the levels of
    /// all tokens, in the order of their ids, of every direction, `[D][S]`.
    fn quantize(
        &self,
        tokens: &[f32],
        places: Places<'_>,
        step: f32,
    ) -> Result<(Vec<Vec<i32>>, Neighbours), ModelError> {
        let bad = |fix| ModelError::BadConfig { key: "step", value: step.to_string(), fix };
        check_step(step).map_err(|reason| bad(format!("{reason}; write a positive number")))?;
        let dim = self.transform.mean.len();
        let num_tokens = tokens.len() / dim;
        let (coefficients, neighbours) = places.sorted(&self.transform.forward(tokens), dim);
        let mut of_direction = Vec::with_capacity(dim);
        for direction in 0..dim {
            let tables = self.tables(direction, &neighbours, step);
            let mut levels = vec![0; num_tokens];
            for (token, &(class, nearest)) in neighbours.iter().enumerate() {
                let value = coefficients[token * dim + direction] / step;
                // A coefficient may be NaN after an overflow.
                if value.is_nan() || value.abs() >= MAX_LEVEL {
                    let fix = format!("token {token} has a coefficient of {value} steps; write a larger step, or f32");
                    return Err(bad(fix));
                }
                let expected = self.prediction.level(class, direction, nearest.map(|token| levels[token]));
                let deviation = (f64::from(value) - f64::from(expected)) as f32;
                levels[token] = expected + cheapest_level(deviation, &tables[class]);
            }
            of_direction.push(levels);
        }
        Ok((of_direction, neighbours))
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
