//! The operations and blocks of encoder and renderer, and both networks.

use burn::nn::{LayerNorm, Linear};
use burn::tensor::Tensor;
use clift_model::{
    Activation, Architecture, CameraEncoding, CliftVariant, CondenserConfig, DecoderBlock, Encoder, EncoderBlock,
    FeedForward, LiftNorm, ModelConfig, RenderTokens, Renderer, SelfAttention, Tokens, cross_sdpa, gelu_linear, linear,
    norm_linear, patchify, plucker, self_sdpa, unpatchify,
};
use clift_train::mse;

use crate::place::{BATCH, DIM, NUM_TOKENS, Place, SIZE, VIEWS, network, values};
use crate::table::{Case, Tolerance, Values};

/// Dot products of a few dozen f32 numbers: the order of the sum changes the last two bits.
const PRODUCT: &str = "sums of 32 to 72 products in another order";
const SOFTMAX: Tolerance =
    Tolerance::both(5e-6, 2e-5, "the same, and another `exp` (a GPU's may be off by 3 units in the last place)");
const BLOCK: Tolerance = Tolerance::both(1e-5, 5e-5, "a chain of those above");
const FEED_FORWARD: Tolerance = Tolerance::both(1e-5, 2e-5, "a chain of those above");

pub const CASES: &[Case] = &[
    Tolerance::forward(1e-6, "a division, a root and three products: each may round another way")
        .case("rays of every pixel", |place| forward(plucker(&place.targets()).flatten(0, 4))),
    Tolerance::forward(0.0, "a look-up in a table")
        .case("8-bit images to values", |place| forward(place.context().images.flatten(0, 4))),
    Tolerance::forward(0.0, "values are moved, not changed").case("images to patches and back", |place| {
        let images = place.random([BATCH, VIEWS, SIZE[0], SIZE[1], 3], 1);
        let patches = patchify(images, 8);
        let back = unpatchify(patches.clone(), [VIEWS, SIZE[0], SIZE[1]], 8);
        forward(Tensor::cat(vec![patches.flatten(0, 2), back.flatten(0, 4)], 0))
    }),
    Tolerance::both(5e-6, 5e-6, PRODUCT).case("linear layer", |place| {
        let layer = place.module(|init| init.linear(DIM, 48));
        place.differentiate(&layer, [place.tokens(1)], |layer, [x]| linear(layer, x))
    }),
    Tolerance::both(1e-5, 1e-5, "the same, and an `erf` from a polynomial that is good to 1.5e-7").case(
        "linear layer of GELU",
        |place| {
            let layer = place.module(|init| init.linear(DIM, 48));
            let x = place.tokens(1).mul_scalar(3.0);
            place.differentiate(&layer, [x], |layer, [x]| gelu_linear(layer, x))
        },
    ),
    Tolerance::both(5e-6, 1e-5, "the same, and two means over a row").case("linear layer of a layer norm", |place| {
        let layers = place.module(|init| (init.layer_norm(DIM), init.linear(DIM, 48)));
        place.differentiate(&layers, [place.tokens(1)], |(norm, layer), [x]| norm_linear(norm, layer, x))
    }),
    FEED_FORWARD.case("feed-forward network, GELU", |place| feed_forward(place, Activation::Gelu)),
    FEED_FORWARD.case("feed-forward network, ReLU", |place| feed_forward(place, Activation::Relu)),
    SOFTMAX.case("self-attention of packed projections", |place| {
        let packed = place.random([BATCH, NUM_TOKENS, 3 * DIM], 1).mul_scalar(2.0);
        place.differentiate(&none(), [packed], |_, [packed]| self_sdpa(packed, 4))
    }),
    SOFTMAX
        .because("the same with larger sums: sizes at which other kernels are chosen, and no multiple of a tile")
        .case("self-attention of 130 tokens, a width of 96", |place| {
            let packed = place.random([1, 130, 3 * 96], 1).mul_scalar(2.0);
            place.differentiate(&none(), [packed], |_, [packed]| self_sdpa(packed, 4))
        }),
    SOFTMAX.case("cross-attention of projections", |place| {
        let inputs = [place.tokens(1), place.random([BATCH, NUM_TOKENS, 2 * DIM], 2).mul_scalar(2.0)];
        place.differentiate(&none(), inputs, |_, [query, key_value]| cross_sdpa(query, key_value, 4))
    }),
    BLOCK.case("self-attention layer", |place| self_attention(place, CliftVariant::Paper)),
    BLOCK
        .because("the same, and a root mean square over the columns of a head")
        .case("self-attention layer with norms of queries and keys", |place| {
            self_attention(place, CliftVariant::ReleasedDl3dv)
        }),
    Tolerance::both(5e-6, 1e-5, "two means over a row, by Burn's own kernel").case(
        "layer norm behind the encoder",
        |place| {
            let norm = place.module(|init| LiftNorm::new(&network(CliftVariant::ReleasedDl3dv), init));
            place.differentiate(&norm, [place.tokens(1)], |norm, [x]| norm.forward(x))
        },
    ),
    BLOCK.case("encoder block", |place| {
        let block = place.module(|init| EncoderBlock::new(&network(CliftVariant::Paper), init));
        place.differentiate(&block, [place.tokens(1)], |block, [x]| block.forward(x, None))
    }),
    BLOCK.case("decoder block, two views of a scene", |place| decoder_block(place, CliftVariant::Paper)),
    BLOCK.case("decoder block with norms of queries and keys", |place| {
        decoder_block(place, CliftVariant::ReleasedDl3dv)
    }),
    BLOCK
        .because("sums of 576 products, rays of their own, and a block")
        .case("encoder, from images", |place| encode(place, &network(CliftVariant::Paper))),
    BLOCK
        .because("the same, and heads transformed by cameras and patches")
        .case("encoder with camera-relative attention", |place| {
            encode(place, &ModelConfig { camera_encoding: CameraEncoding::Gta, ..network(CliftVariant::Paper) })
        }),
    BLOCK
        .because("sums of 384 products, a block and a sigmoid")
        .case("renderer, to images", |place| render(place, RenderTokens::from)),
    BLOCK
        .because("the same; rows of tokens are gathered, and their gradients added")
        .case("renderer, few tokens for each view", |place| {
            render(place, |tokens| RenderTokens::subsets(tokens, &subsets(5)))
        }),
    BLOCK.because("the same with rows of keys and values").case("renderer, most tokens for each view", |place| {
        render(place, |tokens| RenderTokens::subsets(tokens, &subsets(8)))
    }),
    BLOCK
        .because("sums of 576 products, norms without biases and of the columns of a head, and a block")
        .case("encoder of LVSM, latents beside patches", |place| encode(place, &lvsm(CliftVariant::Paper))),
    BLOCK
        .because("the same of 384 products, and a sigmoid")
        .case("renderer of LVSM", |place| render_network(place, &lvsm(CliftVariant::Paper), RenderTokens::from)),
    BLOCK.because("the same with biases, without norms of heads").case("renderer of LVSM in stock blocks", |place| {
        render_network(place, &lvsm(CliftVariant::ReleasedRe10k), RenderTokens::from)
    }),
    Tolerance::both(1e-6, 1e-6, "a sum of 4,608 squares in another order").case("mean squared error", |place| {
        let truth = Place::new(&place.device).random([BATCH, VIEWS, SIZE[0], SIZE[1], 3], 2);
        let rendering = place.random([BATCH, VIEWS * SIZE[0], SIZE[1] * 3], 1);
        place.differentiate(&none(), [rendering], |_, [x]| mse(x.reshape(truth.dims()), truth.clone()))
    }),
];

fn none() -> Vec<Linear> {
    Vec::new()
}

fn forward(result: Tensor<1>) -> Values {
    Values { forward: vec![("result".into(), values(result.inner()))], ..Values::default() }
}

fn feed_forward(place: &Place, activation: Activation) -> Values {
    let layers: (LayerNorm, FeedForward) =
        place.module(|init| (init.layer_norm(DIM), FeedForward::with(activation, DIM, 48, init)));
    place.differentiate(&layers, [place.tokens(1)], |(norm, feed_forward), [x]| feed_forward.forward(norm, x))
}

fn self_attention(place: &Place, variant: CliftVariant) -> Values {
    let network = network(variant);
    let layers = place.module_of(&network, |init| (init.layer_norm(DIM), SelfAttention::new(&network, init)));
    place.differentiate(&layers, [place.tokens(1)], |(norm, attention), [x]| attention.forward(norm, x, None))
}

fn decoder_block(place: &Place, variant: CliftVariant) -> Values {
    let network = network(variant);
    let block = place.module_of(&network, |init| DecoderBlock::new(&network, init));
    let inputs = [place.random([BATCH * VIEWS, 6, DIM], 1), place.tokens(2)];
    place.differentiate(&block, inputs, |block, [x, tokens]| {
        block.forward(x, block.project_tokens(Tokens::without_cameras(tokens)), None)
    })
}

fn encode(place: &Place, network: &ModelConfig) -> Values {
    let encoder = place.module_of(network, |init| Encoder::new(network, init));
    let context = place.context();
    place.differentiate(&encoder, [], |encoder, []| encoder.forward(&context).values)
}

fn render(place: &Place, choose: impl Fn(Tokens) -> RenderTokens) -> Values {
    render_network(place, &network(CliftVariant::Paper), choose)
}

fn lvsm(variant: CliftVariant) -> ModelConfig {
    let (architecture, num_latents, condenser) = (Architecture::LvsmEd, 5, CondenserConfig::NONE);
    ModelConfig { architecture, num_latents, condenser, ..network(variant) }
}

fn render_network(place: &Place, network: &ModelConfig, choose: impl Fn(Tokens) -> RenderTokens) -> Values {
    let renderer = place.module_of(network, |init| Renderer::new(network, init));
    let targets = place.targets();
    place.differentiate(&renderer, [place.tokens(1)], |renderer, [tokens]| {
        renderer.forward(choose(Tokens::without_cameras(tokens)), &targets)
    })
}

/// `count` tokens for every view of every scene; views share some.
pub fn subsets(count: usize) -> Vec<Vec<Vec<u32>>> {
    let subset = |start: usize| (0..count).map(|i| ((start + 5 * i) % NUM_TOKENS) as u32).collect();
    (0..BATCH).map(|scene| (0..VIEWS).map(|view| subset(scene + 3 * view)).collect()).collect()
}
