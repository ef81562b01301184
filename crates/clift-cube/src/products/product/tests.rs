use super::*;
use crate::products::matrix_product::MatrixTile;
use crate::products::register_product::RegisterTile;
use crate::testing::{client, erfc, matrix_client, random, read, rounded, upload};

fn gelu(x: f64) -> f64 {
    0.5 * x * erfc(-x * std::f64::consts::FRAC_1_SQRT_2)
}

/// Checks a product with every step against f64.
fn check(
    client: &Client,
    tile: ProductTile,
    sizes: [usize; 3],
    batch: usize,
    transposed: [bool; 2],
    types: [Values; 3],
) {
    let [m, n, k] = sizes;
    let [lhs_values, rhs_values, output] = types;
    let operands = if matches!(tile, ProductTile::Matrix(_)) { Values::F16 } else { Values::F32 };
    let (a, b) = (random(batch * m * k, 1), random(batch * k * n, 2));
    let (bias, residual) = (random(n, 3), random(batch * m * n, 4));
    let [bias_buffer, residual_buffer] = [&bias, &residual].map(|x| upload(client, x, Values::F32));
    let (lhs, rhs) = (upload(client, &a, lhs_values), upload(client, &b, rhs_values));
    let stride = |transposed: bool, rows: usize, columns: usize| if transposed { rows } else { columns };
    let view = |buffer, transposed, rows, columns| Matrices {
        buffer,
        start: 0,
        batch_stride: rows * columns,
        stride: stride(transposed, rows, columns),
        transposed,
    };
    let product = Product {
        lhs: view(&lhs, transposed[0], m, k),
        rhs: view(&rhs, transposed[1], k, n),
        batch,
        sizes,
        operands,
        bias: Some(&bias_buffer),
        gelu: true,
        residual: Some(&residual_buffer),
        output,
    };
    let computed = read(client, &product.run_tile(client, tile));
    let round = |x: f32, values: Values| if values == Values::F16 || operands == Values::F16 { rounded(x) } else { x };
    let mut worst = 0.0f64;
    for z in 0..batch {
        for i in 0..m {
            for j in 0..n {
                let sum: f64 = (0..k)
                    .map(|t| {
                        let x = a[z * m * k + if transposed[0] { t * m + i } else { i * k + t }];
                        let y = b[z * k * n + if transposed[1] { j * k + t } else { t * n + j }];
                        f64::from(round(x, lhs_values)) * f64::from(round(y, rhs_values))
                    })
                    .sum();
                let index = (z * m + i) * n + j;
                let expected = gelu(sum + f64::from(bias[j])) + f64::from(residual[index]);
                worst = worst.max((expected - f64::from(computed[index])).abs() / (1.0 + expected.abs()));
            }
        }
    }
    let tolerance = if output == Values::F16 { 6e-4 } else { 3e-7 * (k as f64).sqrt().max(8.0) };
    assert!(worst < tolerance, "{tile:?} {sizes:?} {transposed:?} {types:?}: {worst}");
}

const BOTH: [[bool; 2]; 4] = [[false, false], [true, false], [false, true], [true, true]];

#[test]
fn register_tiles_equal_f64() {
    let Some(client) = client() else { return };
    let small = ProductTile::Register(RegisterTile { stage: [64, 64, 16], unit: [4, 4] });
    let large = ProductTile::Register(RegisterTile { stage: [128, 128, 16], unit: [8, 8] });
    let f32 = [Values::F32; 3];
    for transposed in BOTH {
        check(&client, small, [65, 68, 36], 2, transposed, f32);
        check(&client, small, [3, 7, 1], 1, transposed, f32);
    }
    check(&client, large, [130, 129, 40], 1, [false, true], f32);
    // Few tiles and long sums: splits.
    check(&client, small, [12, 70, 1030], 2, [true, false], f32);
    check(&client, small, [20, 24, 33], 1, [false, false], [Values::F16, Values::F32, Values::F16]);
}

#[test]
fn matrix_tiles_equal_f64_of_rounded_operands() {
    let Some((client, shape)) = matrix_client() else { return };
    let tile = |buffers| {
        let [m, n, k] = shape.sizes;
        ProductTile::Matrix(MatrixTile { shape, stage: [2 * m, 4 * n, 2 * k], planes: [2, 2], buffers })
    };
    let small = tile(2);
    for transposed in BOTH {
        check(&client, tile(1), [65, 68, 36], 2, transposed, [Values::F32; 3]);
        check(&client, small, [3, 7, 1], 1, transposed, [Values::F16, Values::F32, Values::F32]);
        check(&client, small, [24, 40, 64], 1, transposed, [Values::F16; 3]);
    }
    check(&client, small, [12, 70, 1030], 2, [true, false], [Values::F32; 3]);
    let table = product_tile(&client, Values::F16, 1, [256, 256, 64], [true, false]);
    check(&client, table, [96, 100, 72], 1, [false, true], [Values::F32, Values::F16, Values::F16]);
}

#[test]
fn products_are_equal_at_every_run() {
    let Some(client) = client() else { return };
    let (lhs, rhs) =
        (upload(&client, &random(70 * 600, 1), Values::F32), upload(&client, &random(600 * 33, 2), Values::F32));
    let mut product = Product::new(Matrices::contiguous(&lhs, 600), Matrices::contiguous(&rhs, 33), [70, 33, 600]);
    for operands in [Values::F32, Values::F16] {
        product.operands = operands;
        let first = read(&client, &product.run(&client));
        assert!((0..3).all(|_| read(&client, &product.run(&client)) == first));
    }
}
