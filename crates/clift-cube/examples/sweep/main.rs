//! Times candidate tiles of products and attention on the shapes of the full-size network, and compares a small size with f64:
//! `sweep spirv full` (or `wgsl`, or `tiny` for software Vulkan), then optionally the first candidate to run.
//!
//! Prints JSON objects, one a line: the adapter; for every candidate its number and name before it runs, and its results
//! after. A candidate that fails ends the process, whose device may be unusable: start again at the next number. The most
//! valuable candidates come first. `scripts/bench/gpu_bench.py` does all that.

#[path = "../../src/testing/cases.rs"]
mod cases;
mod measure;
mod products;

use clift_cube::{
    AdapterClass, AttentionGradients, AttentionSizes, AttentionTile, Buffer, HeadRows, Matrices, Product, ProductTile,
    Values, attention_backward, attention_forward,
};
use cubecl::device::{Device, RuntimeId, WgpuDeviceKind};
use cubecl::prelude::Client;
use cubecl::wgpu::{WgpuServer, WgslCompiler};

use crate::cases::AttentionPart;
use crate::measure::Sweep;
use crate::products::{Layer, matrix_tiles, register_tiles};

/// Sizes of a network and its batch.
#[derive(Clone, Copy)]
struct Sizes {
    batch: usize,
    /// Context tokens of a scene.
    tokens: usize,
    /// Patches of a target.
    queries: usize,
    num_heads: usize,
    head_width: usize,
    feed_forward: usize,
}

impl Sizes {
    const FULL: Self = Self { batch: 4, tokens: 4096, queries: 1024, num_heads: 8, head_width: 96, feed_forward: 2048 };
    /// Software Vulkan compiles wide cooperative matrices for minutes.
    const TINY: Self = Self { batch: 2, tokens: 128, queries: 48, num_heads: 2, head_width: 16, feed_forward: 72 };

    fn dim(self) -> usize {
        self.num_heads * self.head_width
    }
}

fn main() {
    let mut arguments = std::env::args().skip(1);
    let mut next = || arguments.next();
    let (compiler, size) = (next().expect("spirv or wgsl"), next().expect("full or tiny"));
    let first = next().map_or(0, |text| text.parse().expect("the number of a candidate"));
    let device = Device::wgpu(WgpuDeviceKind::DefaultDevice).expect("an adapter");
    let (client, class) = match compiler.as_str() {
        // The adapter may have cooperative matrices: then kernels with them run, and their results are wrong.
        "wgsl" => (Client::load::<WgpuServer<WgslCompiler>>(RuntimeId::strip(device.to_id())), AdapterClass::Registers),
        _ if cfg!(feature = "spirv") => {
            let client = device.client();
            let class = AdapterClass::of(&client);
            (client, class)
        }
        _ => panic!("build with `--features spirv`"),
    };
    println!(
        "{{\"adapter\":\"{}\",\"compiler\":\"{compiler}\",\"class\":\"{class:?}\"}}",
        client.properties().identity.name
    );
    let sizes = if size == "full" { Sizes::FULL } else { Sizes::TINY };
    run(&mut Sweep::new(&client, first), class, sizes);
}

/// Runs all candidates. Kernels are compiled once for all shapes: the later shapes take little time.
fn run(sweep: &mut Sweep, class: AdapterClass, sizes: Sizes) {
    let shape = if let AdapterClass::Matrices(shape) = class { Some(shape) } else { None };
    let (matrices, registers) = (matrix_tiles(shape), register_tiles());
    let shared_bytes = sweep.client.properties().hardware.max_shared_memory_size;
    // Planes, and columns in matrices.
    let attention_tiles = shape.into_iter().flat_map(|shape| {
        let width = sizes.head_width;
        [(8, 2), (4, 2), (8, 1), (4, 4), (2, 4), (2, 2), (8, 4)].map(|(planes, columns)| AttentionTile {
            shape,
            planes,
            columns: columns * shape.sizes[0],
            width,
        })
    });
    let attention_tiles = attention_tiles.filter(|tile| tile.shared_bytes() <= shared_bytes);
    let attention_tiles: Vec<(String, Option<AttentionTile>)> =
        attention_tiles.map(|tile| (format!("planes {}, columns {}", tile.planes, tile.columns), Some(tile))).collect();
    let attention_registers = [("registers".to_owned(), None)];
    let layers = Layer::all(sizes);

    let [forward, input, weight] = layers[0].products();
    forward.run(sweep, &matrices, Values::F32);
    attentions(sweep, sizes, [sizes.tokens; 2], &attention_tiles);
    weight.run(sweep, &matrices, Values::F32);
    input.run(sweep, &matrices, Values::F32);
    forward.run(sweep, &matrices, Values::F16);
    for product in layers[0].products() {
        product.run(sweep, &registers, Values::F32);
    }
    attentions(sweep, sizes, [sizes.tokens; 2], &attention_registers);
    input.run(sweep, &matrices, Values::F16);
    weight.run(sweep, &matrices, Values::F16);
    for product in layers[1..].iter().flat_map(Layer::products) {
        product.run(sweep, &matrices, Values::F32);
        product.run(sweep, &registers, Values::F32);
    }
    for counts in [[sizes.queries, sizes.tokens], [sizes.queries; 2]] {
        attentions(sweep, sizes, counts, &attention_tiles);
        attentions(sweep, sizes, counts, &attention_registers);
    }
}

/// Runs attention, forward and both kernels of the backward.
fn attentions(
    sweep: &mut Sweep,
    sizes: Sizes,
    [num_queries, num_keys]: [usize; 2],
    tiles: &[(String, Option<AttentionTile>)],
) {
    let Sizes { batch, num_heads, head_width, .. } = sizes;
    // Products of scores that a kernel computes.
    for (kernel, products, gradients) in [
        ("attention forward", 2, None),
        ("attention backward by queries", 3, Some(AttentionGradients::Queries)),
        ("attention backward by keys", 4, Some(AttentionGradients::KeysAndValues)),
    ] {
        let flops = 2.0 * (products * batch * num_queries * num_keys * sizes.dim()) as f64;
        sweep.run(kernel, &format!("{num_queries} queries, {num_keys} keys"), flops, tiles, |tile, is_small| {
            let [batch, num_queries, num_keys] = if is_small { [1, 150, 140] } else { [batch, num_queries, num_keys] };
            let tiles = [tile; 2];
            let sizes = AttentionSizes { batch, num_heads, num_queries, num_keys, head_width, tiles };
            cases::attention(sizes, gradients.map_or(AttentionPart::Forward, AttentionPart::Backward))
        });
    }
}
