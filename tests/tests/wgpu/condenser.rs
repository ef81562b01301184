//! All forms of the condenser, and attention inside clusters.

use burn::tensor::{Int, Tensor};
use clift_model::{
    CliftVariant, Clusters, Condenser, CondenserConfig, ModelConfig, SceneClusters, Tokens, cluster_attention,
};

use crate::place::{BATCH, DIM, NUM_TOKENS, Place, clusters, network};
use crate::table::{Case, Tolerance, Values};

const BLOCKS: Tolerance =
    Tolerance::both(2e-5, 1e-4, "attention, attention inside clusters and a feed-forward network, twice");

pub const CASES: &[Case] = &[
    Tolerance::both(
        5e-6,
        2e-5,
        "sums over the members of a cluster in the order in which a GPU's threads arrive, and another `exp`",
    )
    .case("attention inside clusters: uneven, of one, empty", |place| {
        let num_segments = 5;
        // Of six, one, four and one member, and none; evenly.
        let first: [i64; NUM_TOKENS] = [0, 0, 1, 2, 0, 0, 3, 2, 0, 2, 2, 0];
        let second: [i64; NUM_TOKENS] = [5, 6, 7, 8, 9, 5, 6, 7, 8, 9, 5, 6];
        let rows = [first, second].concat();
        let count = rows.len();
        let rows = Tensor::<1, Int>::from_data(burn::tensor::TensorData::new(rows, [count]), &place.device);
        let query = place.random([BATCH, num_segments, DIM], 1).mul_scalar(2.0);
        let key_value = place.random([BATCH, NUM_TOKENS, 2 * DIM], 2);
        let nothing: Vec<burn::nn::Linear> = Vec::new();
        place.differentiate(&nothing, [query, key_value], |_, [query, key_value]| {
            cluster_attention(query, key_value, rows, 4)
        })
    }),
    BLOCKS.case("condenser, with residuals", |place| condense(place, &paper(true), place.tokens(1), clusters())),
    BLOCKS.case("condenser, equations as printed", |place| condense(place, &paper(false), place.tokens(1), clusters())),
    BLOCKS.because("the same parts once, with ReLU").case("condenser of `released-re10k`", |place| {
        condense(place, &network(CliftVariant::ReleasedRe10k), place.tokens(1), clusters())
    }),
    BLOCKS.because("the same with norms of queries and keys").case("condenser of `released-dl3dv`", |place| {
        condense(place, &network(CliftVariant::ReleasedDl3dv), place.tokens(1), clusters())
    }),
    BLOCKS.case("condenser, tokens that are equal", |place| {
        let some = place.tokens(1).narrow(1, 0, NUM_TOKENS / 3);
        condense(place, &paper(true), some.repeat_dim(1, 3), clusters())
    }),
    BLOCKS.because("without attention inside clusters").case("condenser, every token alone", |place| {
        condense(place, &paper(true), place.tokens(1), vec![SceneClusters::identity(NUM_TOKENS); BATCH])
    }),
    BLOCKS.case("condenser, one cluster", |place| {
        let all = SceneClusters::new(vec![0; NUM_TOKENS], vec![5]).expect("one cluster");
        condense(place, &paper(true), place.tokens(1), vec![all; BATCH])
    }),
];

fn paper(residual: bool) -> ModelConfig {
    ModelConfig {
        condenser: CondenserConfig { num_blocks: 2, residual, member_share: false },
        ..network(CliftVariant::Paper)
    }
}

fn condense(place: &Place, config: &ModelConfig, lift: Tensor<3>, scenes: Vec<SceneClusters>) -> Values {
    let condenser = place.module(|init| Condenser::new(config, init));
    let index = Clusters::new(scenes).expect("equal counts").upload(&place.device);
    place.differentiate(&condenser, [lift.detach()], |condenser, [lift]| {
        condenser.forward(Tokens::without_cameras(lift), &index).values
    })
}
