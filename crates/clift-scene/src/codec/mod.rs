//! The transform coder for the tokens of scene files: slices in, words out.
//!
//! - `entropy`: a stream of symbols with 16-bit probabilities, and the set of token ids
//! - `transform`: mean and Karhunen-Loeve basis, fitted on second moments
//! - `histogram`: the distribution of every coefficient, fitted on tokens
//! - `prediction`: expected coefficients, from earlier tokens of the same view
//! - `table`: probabilities of quantized coefficients for a step
//! - `rates`: measured loss by token count and step
//! - `token_codec`: a model's codec: tokens to words and back
//! - `file`: `codec.safetensors`
//! - `fit`: a codec from training scenes: transform, distributions, and measured rates

pub(crate) mod entropy;
pub(crate) mod file;
pub(crate) mod fit;
pub(crate) mod histogram;
pub(crate) mod prediction;
pub(crate) mod rates;
pub(crate) mod table;
pub(crate) mod token_codec;
pub(crate) mod transform;
