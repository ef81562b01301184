//! Times every tile of the products, and attention, on an adapter, one JSON object a line:
//! `cargo run --release -p clift-cube --features spirv --example sweep -- 4 attention` with the divisor of the sizes, 1 for
//! the full network at batch 4, and `products` or `attention` for one of the two.

use std::time::{Duration, Instant};

use clift_cube::{
    AdapterClass, AttentionInputs, AttentionResults, AttentionSizes, AttentionTile, Buffer, HeadRows, Matrices,
    MatrixTile, Product, ProductTile, RegisterTile, Values, attention_backward_tile, attention_forward_tile,
};
use cubecl::Device;
use cubecl::prelude::Client;

const HEAD_WIDTH: usize = 96;

fn main() {
    let mut arguments = std::env::args().skip(1);
    let divisor: usize = arguments.next().map_or(1, |text| text.parse().expect("the divisor of the sizes"));
    let part = arguments.next();
    let is_part = |name: &str| part.as_deref().is_none_or(|part| part == name);
    let client = Device::Wgpu(cubecl::device::WgpuDevice::default()).client();
    let class = AdapterClass::of(&client);
    println!("{{\"adapter\":\"{}\",\"class\":\"{class:?}\"}}", client.name());
    if is_part("products") {
        time_products(&client, class, divisor);
    }
    if is_part("attention") {
        let count = 4096 / divisor;
        time_attention(&client, count, None);
        if let AdapterClass::Matrices(shape) = class {
            for (planes, columns) in [(8, 2), (4, 2), (4, 4), (2, 2)] {
                let columns = columns * shape.sizes[0];
                time_attention(&client, count, Some(AttentionTile { shape, planes, columns, width: HEAD_WIDTH }));
            }
        }
    }
}

fn time_products(client: &Client, class: AdapterClass, divisor: usize) {
    // A projection of queries, keys and values, of the feed-forward network and of attention, at batch 4.
    let layers = [[16_384, 2304, 768], [16_384, 2048, 768], [16_384, 768, 2048], [16_384, 768, 768]];
    for sizes in layers.map(|sizes| sizes.map(|size| size / divisor)) {
        let [rows, outputs, inputs] = sizes;
        // The layer, the gradient of its input and of its weight.
        let products = [
            ("forward", [rows, outputs, inputs], [false, false]),
            ("input", [rows, inputs, outputs], [false, true]),
            ("weight", [inputs, outputs, rows], [true, false]),
        ];
        for (name, sizes, transposed) in products {
            for tile in tiles(class) {
                time_product(client, name, sizes, transposed, tile);
            }
        }
    }
}

/// Returns the tiles to time on an adapter.
fn tiles(class: AdapterClass) -> Vec<ProductTile> {
    let registers =
        [([128, 128, 16], [8, 8]), ([64, 128, 16], [4, 8]), ([64, 64, 16], [4, 4]), ([128, 128, 8], [8, 8])];
    let registers = registers.map(|(stage, unit)| ProductTile::Register(RegisterTile { stage, unit }));
    let AdapterClass::Matrices(shape) = class else { return registers.into() };
    let [size, ..] = shape.sizes;
    let matrices = [
        ([8, 8, 2], [2, 4]),
        ([8, 8, 2], [2, 2]),
        ([8, 8, 4], [2, 4]),
        ([8, 4, 2], [2, 2]),
        ([4, 8, 2], [2, 2]),
        ([16, 8, 2], [4, 2]),
        ([4, 4, 2], [2, 2]),
    ];
    let matrices = matrices.map(|(stage, planes): ([usize; 3], [usize; 2])| {
        ProductTile::Matrix(MatrixTile { shape, stage: stage.map(|count| count * size), planes })
    });
    matrices.into_iter().chain(registers).collect()
}

fn wait(client: &Client) {
    cubecl::future::block_on(client.sync()).expect("a device that works");
}

/// Returns the milliseconds of the first run, which compiles, and the mean of the later runs, as fields of an object, or the
/// error of the kernel.
fn time(client: &Client, work: f64, run: impl Fn() -> Vec<Buffer>) -> String {
    wait(client);
    let start = Instant::now();
    let results = run();
    wait(client);
    let first = start.elapsed();
    // The error of a refused launch appears when its result is read.
    for buffer in results {
        let end = buffer.handle.size().saturating_sub(256);
        if let Err(error) = client.read_one(buffer.handle.offset_start(end)) {
            let line = error.to_string().replace(['"', '\n'], " ");
            return format!("\"error\":\"{line}\"");
        }
    }
    let mut runs = 0;
    let start = Instant::now();
    while runs < 3 || (start.elapsed() < Duration::from_millis(150) && runs < 20) {
        run();
        runs += 1;
        wait(client);
    }
    let again = start.elapsed().as_secs_f64() / f64::from(runs);
    format!(
        "\"first_ms\":{:.1},\"ms\":{:.3},\"tflops\":{:.3}",
        1e3 * first.as_secs_f64(),
        1e3 * again,
        1e-12 * work / again
    )
}

fn upload(client: &Client, len: usize, values: Values) -> Buffer {
    let value = |i: usize| ((i * 7919 + i / 61 * 31) % 2003) as f32 / 1001.0 - 1.0;
    let bytes: Vec<u8> = match values {
        Values::F32 => (0..len).flat_map(|i| value(i).to_le_bytes()).collect(),
        Values::F16 => (0..len).flat_map(|i| half::f16::from_f32(value(i)).to_le_bytes()).collect(),
    };
    Buffer { handle: client.create_from_slice(&bytes), len, values }
}

fn time_product(client: &Client, name: &str, sizes: [usize; 3], transposed: [bool; 2], tile: ProductTile) {
    let [m, n, k] = sizes;
    let operands = if matches!(tile, ProductTile::Matrix(_)) { Values::F16 } else { Values::F32 };
    let [lhs, rhs] = [m * k, k * n].map(|len| upload(client, len, operands));
    let view = |buffer, transposed: bool, [rows, columns]: [usize; 2]| Matrices {
        transposed,
        ..Matrices::contiguous(buffer, if transposed { rows } else { columns })
    };
    let [lhs, rhs] = [view(&lhs, transposed[0], [m, k]), view(&rhs, transposed[1], [k, n])];
    let product = Product { operands, ..Product::new(lhs, rhs, sizes) };
    let times = time(client, 2.0 * (m * n * k) as f64, || vec![product.run_tile(client, tile)]);
    println!("{{\"product\":\"{name}\",\"sizes\":{sizes:?},\"tile\":\"{tile:?}\",{times}}}");
}

fn time_attention(client: &Client, count: usize, tile: Option<AttentionTile>) {
    let (batch, num_heads, head_width) = (4, 8, HEAD_WIDTH);
    let operands = if tile.is_some() { Values::F16 } else { Values::F32 };
    let sizes = AttentionSizes { batch, num_heads, num_queries: count, num_keys: count, head_width, operands };
    let dim = num_heads * head_width;
    let packed = upload(client, batch * count * 3 * dim, Values::F32);
    let columns = |part| HeadRows { buffer: &packed, column: part * dim, stride: 3 * dim };
    let inputs = AttentionInputs { query: columns(0), key: columns(1), value: columns(2) };
    let line = |name: &str, times: String| {
        println!("{{\"attention\":\"{name}\",\"tile\":\"{tile:?}\",\"tokens\":{count},{times}}}");
    };
    let work = 4.0 * (batch * count * count * dim) as f64;
    line("forward", time(client, work, || attention_forward_tile(client, sizes, &inputs, tile).into()));
    let [output, log_sum] = attention_forward_tile(client, sizes, &inputs, tile);
    let results = AttentionResults { output: &output, log_sum: &log_sum, grad_output: &output };
    let times = time(client, 2.5 * work, || {
        let grad = Buffer::empty(client, packed.len, Values::F32);
        let columns = |part| HeadRows { buffer: &grad, column: part * dim, stride: 3 * dim };
        let grads = AttentionInputs { query: columns(0), key: columns(1), value: columns(2) };
        attention_backward_tile(client, sizes, &inputs, results, &grads, tile);
        vec![grad]
    });
    line("backward", times);
}
