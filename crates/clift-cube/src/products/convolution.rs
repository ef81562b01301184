//! Convolutions by kernels of 3 x 3 with zeros around the image: im2col, then a product.
// B images, H rows, W columns, C channels

use cubecl::prelude::*;

use crate::buffers::buffer::{Buffer, Matrices, Values};
use crate::buffers::elementwise::{UNITS, cube_count};
use crate::products::product::Product;

/// Values of a kernel.
pub const KERNEL_LEN: usize = 9;

/// Computes a convolution of images `[B, H, W, C]`: `[B, H, W, outputs]`. `weight` is a matrix `[9 C, outputs]` in the order
/// row, column, channel. Allocates `9 B H W C` values.
pub fn convolve(
    client: &Client,
    x: &Buffer,
    [batch, height, width, channels]: [usize; 4],
    weight: Matrices,
    outputs: usize,
    bias: Option<&Buffer>,
) -> Buffer {
    let (pixels, terms) = (height * width, KERNEL_LEN * channels);
    let windows = Buffer::empty(client, batch * pixels * terms, Values::F32);
    let vector = if channels.is_multiple_of(4) { 4 } else { 1 };
    let units = windows.len / vector;
    // SAFETY: the kernel compares its index with the length and pixels with the sizes.
    unsafe {
        im2col::launch_unchecked(
            client,
            cube_count(units.div_ceil(UNITS)),
            CubeDim::new_1d(UNITS as u32),
            vector,
            x.arg(vector),
            windows.arg(vector),
            height,
            width,
            channels / vector,
        );
    }
    let lhs = Matrices::contiguous(&windows, terms);
    Product { bias, ..Product::new(lhs, weight, [batch * pixels, outputs, terms]) }.run(client)
}

/// Copies the 3 x 3 window of every pixel to a row, zeros outside the image. `channels` counts vectors.
#[cube(launch_unchecked)]
fn im2col<V: Size>(x: &[Vector<f32, V>], output: &mut [Vector<f32, V>], height: usize, width: usize, channels: usize) {
    let index = ABSOLUTE_POS;
    if index < output.len() {
        let channel = index % channels;
        let neighbour = index / channels % KERNEL_LEN;
        let pixel = index / (channels * KERNEL_LEN);
        // One more than the position, to stay positive.
        let row = pixel / width % height + neighbour / 3;
        let column = pixel % width + neighbour % 3;
        let mut values = Vector::<f32, V>::new(0.0);
        if row > 0 && row <= height && column > 0 && column <= width {
            let image = pixel / (height * width);
            values = x[((image * height + row - 1) * width + column - 1) * channels + channel];
        }
        output[index] = values;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::cases::{Case, random};
    use crate::testing::{check, client};

    #[test]
    fn convolutions_equal_f64() {
        let Some(client) = client() else { return };
        for [batch, height, width, channels, outputs] in [[1, 1, 1, 3, 5], [2, 5, 7, 3, 8], [1, 6, 4, 8, 70]] {
            let lens = [batch * height * width * channels, KERNEL_LEN * channels * outputs, outputs];
            let run = move |client: &Client, inputs: &[Buffer]| {
                let weight = Matrices::contiguous(&inputs[1], outputs);
                vec![convolve(client, &inputs[0], [batch, height, width, channels], weight, outputs, Some(&inputs[2]))]
            };
            let case = Case::new(
                move || lens.map(|len| random(len, len as u64, 1.0)),
                run,
                move |inputs| {
                    let [x, weight, bias] = inputs else { panic!("three inputs") };
                    let value = |i: usize| {
                        let (pixel, output) = (i / outputs, i % outputs);
                        let (image, row, column) = (pixel / (height * width), pixel / width % height, pixel % width);
                        let terms = (0..KERNEL_LEN * channels).map(|term| {
                            let (n, channel) = (term / channels, term % channels);
                            let (row, column) = ((row + n / 3).wrapping_sub(1), (column + n % 3).wrapping_sub(1));
                            let is_inside = row < height && column < width;
                            let value = || x[((image * height + row) * width + column) * channels + channel];
                            if is_inside { value() * weight[term * outputs + output] } else { 0.0 }
                        });
                        bias[output] + terms.sum::<f64>()
                    };
                    vec![(0..batch * height * width * outputs).map(value).collect()]
                },
            );
            check(&client, &case, 1e-5);
        }
    }
}
