//! The encoder: context views to tokens.

use crate::network::architecture::Architecture;
use crate::network::clift::encoder::PatchEncoder;
use crate::network::config::ModelConfig;
use crate::network::design::EncoderBlocks;
use crate::network::init::Init;
use crate::network::lvsm_ed::LatentEncoder;
use crate::network::parts::module_enum::module_enum;
use crate::network::tokens::Tokens;
use crate::views::upload::Views;

module_enum! {
    /// An encoder. Its result is the residual stream without a norm; one variant applies a [`LiftNorm`](crate::LiftNorm)
    /// to it.
    Encoder {
        /// One token per patch.
        Clift(PatchEncoder),
        /// Learned latents.
        LvsmEd(LatentEncoder),
    }
}

impl Encoder {
    /// Makes an encoder of the sizes of `config`.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        match config.architecture {
            Architecture::Clift => Self::Clift(PatchEncoder::new(config, init)),
            Architecture::LvsmEd => Self::LvsmEd(LatentEncoder::new(config, init)),
        }
    }

    /// Encodes context views into tokens.
    ///
    /// # Shapes
    /// - returns `[batch, num_tokens, dim]`; tokens of patches are ordered by view, row, column
    pub fn forward(&self, context: &Views) -> Tokens {
        let blocks = self.blocks();
        let transforms = blocks.transforms(&context.cameras);
        let forward = |x, index| blocks.block(index, x, transforms.as_ref());
        let values = (0..blocks.num_blocks()).fold(blocks.embed(context), forward);
        Tokens { values, transforms }.joined(context.cameras.dims()[0])
    }

    pub(crate) fn blocks(&self) -> &dyn EncoderBlocks {
        match self {
            Self::Clift(encoder) => encoder,
            Self::LvsmEd(encoder) => encoder,
        }
    }
}
