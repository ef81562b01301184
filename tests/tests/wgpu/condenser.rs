//! The condenser in all its forms, and the attention inside clusters that it is made of.

use burn::tensor::{Int, Tensor};
use clift_model::cluster_attention::cluster_attention;
use clift_model::{Clusters, Condenser, CondenserConfig, ModelConfig, SceneClusters, Variant};

use crate::place::{BATCH, DIM, NUM_TOKENS, Place, clusters, network};
use crate::table::{Case, Values};

const BLOCKS: &str = "attention, attention inside clusters and a feed-forward network, twice";

pub const CASES: &[Case] = &[
    Case {
        operation: "attention inside clusters: uneven, of one, empty",
        forward: 5e-6,
        backward: Some(2e-5),
        reason: "sums over the members of a cluster in the order in which a GPU's threads arrive, and another `exp`",
        run: |place| {
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
                cluster_attention(query, key_value, rows, 4).flatten(0, 2)
            })
        },
    },
    Case {
        operation: "condenser, with residuals",
        forward: 2e-5,
        backward: Some(1e-4),
        reason: BLOCKS,
        run: |place| condense(place, &paper(true), place.tokens(1), clusters()),
    },
    Case {
        operation: "condenser, equations as printed",
        forward: 2e-5,
        backward: Some(1e-4),
        reason: BLOCKS,
        run: |place| condense(place, &paper(false), place.tokens(1), clusters()),
    },
    Case {
        operation: "condenser of `released-re10k`",
        forward: 2e-5,
        backward: Some(1e-4),
        reason: "the same parts once, with ReLU",
        run: |place| condense(place, &network(Variant::ReleasedRe10k), place.tokens(1), clusters()),
    },
    Case {
        operation: "condenser of `released-dl3dv`",
        forward: 2e-5,
        backward: Some(1e-4),
        reason: "the same with norms of queries and keys",
        run: |place| condense(place, &network(Variant::ReleasedDl3dv), place.tokens(1), clusters()),
    },
    Case {
        operation: "condenser, tokens that are equal",
        forward: 2e-5,
        backward: Some(1e-4),
        reason: BLOCKS,
        run: |place| {
            let some = place.tokens(1).narrow(1, 0, NUM_TOKENS / 3);
            condense(place, &paper(true), some.repeat_dim(1, 3), clusters())
        },
    },
    Case {
        operation: "condenser, every token alone",
        forward: 2e-5,
        backward: Some(1e-4),
        reason: "without attention inside clusters",
        run: |place| condense(place, &paper(true), place.tokens(1), vec![SceneClusters::identity(NUM_TOKENS); BATCH]),
    },
    Case {
        operation: "condenser, one cluster",
        forward: 2e-5,
        backward: Some(1e-4),
        reason: BLOCKS,
        run: |place| {
            let all = SceneClusters::new(vec![0; NUM_TOKENS], vec![5]).expect("one cluster");
            condense(place, &paper(true), place.tokens(1), vec![all; BATCH])
        },
    },
];

fn paper(residual: bool) -> ModelConfig {
    ModelConfig { condenser: CondenserConfig { num_blocks: 2, residual }, ..network(Variant::Paper) }
}

fn condense(place: &Place, config: &ModelConfig, lift: Tensor<3>, scenes: Vec<SceneClusters>) -> Values {
    let condenser = place.module(|init| Condenser::new(config, init));
    let index = Clusters::new(scenes).expect("equal counts").upload(&place.device);
    place.differentiate(&condenser, [lift.detach()], |condenser, [lift]| condenser.forward(lift, &index).flatten(0, 2))
}
