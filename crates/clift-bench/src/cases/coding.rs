//! The rows of the token coder, which runs on the host.

use burn::tensor::Device;
use clift_core::step_rng;
use clift_data::DataConfig;
use clift_model::TokenKind;
use clift_scene::{Histograms, NeighbourProducts, Places, RateTable, TokenCodec, Transform};
use clift_train::TrainError;
use rand::RngExt;

use crate::cases::context::BenchContext;
use crate::cases::task::BenchTask;

/// Directions in which the deviation of a token halves. With 16, a value of the tokens takes 1 to 2 bits at width 768.
const DIRECTIONS_PER_HALVING: f64 = 16.0;
/// Deviation of the first direction in steps.
const FIRST_DEVIATION: f64 = 32.0;

/// Codes or decodes the stored tokens of a scene, whose coefficients are two-sided exponential.
pub struct CodingCase {
    codec: TokenCodec,
    tokens: Vec<f32>,
    ids: Vec<u32>,
    grid: [usize; 3],
    /// The coded tokens; `None` for the row that codes.
    words: Option<Vec<u32>>,
}

const STEP: f32 = 1.0;

impl CodingCase {
    pub fn new(context: &BenchContext, is_decoder: bool) -> Result<Self, TrainError> {
        let (dim, num_patches, count) =
            (context.config.model.dim, context.num_tokens()?, context.num_storage_tokens()?);
        let deviations: Vec<f32> = (0..dim)
            .map(|d| (FIRST_DEVIATION * (-(d as f64) / DIRECTIONS_PER_HALVING).exp2()).max(1e-3) as f32)
            .collect();
        let mut rng = step_rng(context.config.seed, 0, "bench tokens");
        let tokens: Vec<f32> = (0..count * dim)
            .map(|i| {
                let uniform: f32 = rng.random_range(-1.0..1.0);
                // Of variance one before the deviation.
                -uniform.signum() * (1.0 - uniform.abs()).max(1e-7).ln() / 2.0_f32.sqrt() * deviations[i % dim]
            })
            .collect();
        let basis = (0..dim * dim).map(|i| f32::from(u8::from(i % dim == i / dim))).collect();
        let transform = Transform { mean: vec![0.0; dim], basis, deviations };
        let DataConfig { width, height, views, .. } = &context.config.data;
        let [rows, columns] = [*height, *width].map(|side| side / context.config.model.patch_size);
        let grid = [views.min_context, rows, columns];
        let ids: Vec<u32> = (0..count).map(|i| (i * num_patches / count) as u32).collect();
        let places = Places { ids: &ids, grid };
        let mut products = NeighbourProducts::new(dim);
        products.add(&transform, &tokens, places);
        let prediction = products.prediction(&transform);
        let mut histograms = Histograms::new(dim);
        histograms.add(&transform, &prediction, &tokens, places);
        let rates = RateTable {
            shares: vec![1.0],
            steps: vec![1.0, 2.0],
            bits: vec![1.0, 0.5],
            loss: vec![0.1, 0.2],
            psnr: vec![20.0],
        };
        let network = (context.config.model.clone(), TokenKind::Clift, String::new());
        let codec = TokenCodec::new(network, (transform, prediction), histograms.distributions(), rates)?;
        let words = is_decoder.then(|| codec.encode(&tokens, places, STEP)).transpose()?;
        Ok(Self { codec, tokens, ids, grid, words })
    }
}

impl BenchTask for CodingCase {
    fn run(&mut self) -> Result<(), TrainError> {
        match &self.words {
            None => {
                let places = Places { ids: &self.ids, grid: self.grid };
                drop(self.codec.encode(&self.tokens, places, STEP)?);
            }
            Some(words) => {
                let decoded = self.codec.decode(words.clone(), self.ids.len(), self.grid, STEP);
                drop(decoded.expect("words of this codec"));
            }
        }
        Ok(())
    }

    /// Returns no error: rounding is the coder's purpose. The tests of clift-model compare decoded with rounded tokens.
    fn error(self: Box<Self>, _reference: &Device) -> Result<Option<f64>, TrainError> {
        Ok(None)
    }
}
