//! Storage of the tokens of a scene file: plain numbers, or coded for a loss or a size.

use std::path::Path;

use clift_model::{ModelError, TokenCount, TrainedModel};

use crate::codec::token_codec::TokenCodec;
use crate::encode::contexts::Contexts;
use crate::error::SceneError;
use crate::scene::token_coding::{CodedLoss, TokenCoding};
use crate::scene::token_format::TokenFormat;

/// Storage of the tokens of a scene file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Coding {
    /// Numbers of one format.
    Plain(TokenFormat),
    /// Coded with at most this loss of PSNR in dB by the rates of the model.
    ExpectedLoss(f64),
    /// Coded with at most this loss of PSNR in dB, measured on the scene.
    MeasuredLoss(f64),
    /// Coded into a file of at most this number of bytes.
    Bytes(u64),
}

impl From<TokenCoding> for Coding {
    fn from(coding: TokenCoding) -> Self {
        match coding {
            TokenCoding::Plain(format) => Self::Plain(format),
            TokenCoding::Coded(loss) => Self::ExpectedLoss(loss.db()),
        }
    }
}

/// A coding with the codec that it needs.
pub(crate) enum Coder {
    Plain(TokenFormat),
    Expected(TokenCodec, f64),
    Measured(TokenCodec, f64),
    Bytes(TokenCodec, u64),
}

impl Coder {
    /// Reads the codec beside the weights. Without a coding, tokens are coded with the default loss if there is a codec, else
    /// stored in f16.
    pub fn new(coding: Option<Coding>, weights: &Path, model: &TrainedModel) -> Result<Self, SceneError> {
        let architecture = model.config.architecture;
        if !matches!(coding, None | Some(Coding::Plain(_))) && !architecture.supports_clusters() {
            return Err(SceneError::request(format!(
                "the tokens of {architecture} have no codec; store them with --format f32, f16 or int8"
            )));
        }
        let found = || TokenCodec::beside(weights, model);
        let codec = || found()?.ok_or_else(|| ModelError::NoCodec { path: TokenCodec::path_of(weights) });
        Ok(match coding {
            Some(Coding::Plain(format)) => Self::Plain(format),
            Some(Coding::ExpectedLoss(loss)) => Self::Expected(codec()?, loss),
            Some(Coding::MeasuredLoss(loss)) => Self::Measured(codec()?, loss),
            Some(Coding::Bytes(bytes)) => Self::Bytes(codec()?, bytes),
            None => match found()? {
                Some(codec) => Self::Expected(codec, CodedLoss::default().db()),
                None => Self::Plain(TokenFormat::F16),
            },
        })
    }
}

/// Returns the number of stored tokens of the best expected PSNR in a file of `bytes`: of a single group a share of its tokens, of
/// several a number, for which there may be fewer groups.
pub(crate) fn count_for_bytes(
    (codec, bytes): (&TokenCodec, u64),
    contexts: &Contexts,
    [height, width]: [usize; 2],
    model_path: &str,
) -> TokenCount {
    let num_members = contexts.num_members();
    let num_patches = codec.model.num_patches(num_members, height, width).unwrap_or(1);
    let tokens = bytes as f64 - coded_overhead(contexts.frames.len(), num_members, model_path.len()) as f64;
    let share = codec.rates.share_for_bytes(num_patches, tokens.max(1.0));
    if contexts.groups.len() == 1 {
        return TokenCount::Share(share);
    }
    TokenCount::Count(((share * num_patches as f64) as usize).max(1))
}

/// Bytes of a coded file besides its tokens, about: header, normalization, the views, and the groups.
fn coded_overhead(num_views: usize, num_members: usize, path_len: usize) -> usize {
    400 + path_len + 68 * num_views + 3 * num_members
}
