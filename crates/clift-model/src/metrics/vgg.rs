//! VGG features: 3 x 3 convolutions in five stages with pooling between the stages.
// B images, C channels, H rows, W columns

use burn::tensor::activation::relu;
use burn::tensor::module::{avg_pool2d, max_pool2d};
use burn::tensor::ops::{AvgPoolOptions, MaxPoolOptions};
use burn::tensor::{DType, Device, Tensor};

use crate::error::ModelError;
use crate::metrics::network_file::NetworkFile;
use crate::ops::convolution::convolution;

/// Number of stages. Pooling halves the image between stages.
pub const NUM_STAGES: usize = 5;

/// Smallest side of an image for which every stage has a value.
pub const MIN_SIZE_PX: usize = 1 << (NUM_STAGES - 1);

/// Pooling over 2 x 2 values. An odd last row or column is dropped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pooling {
    Max,
    Average,
}

/// Sizes of a network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct VggShape {
    /// Channels of each stage.
    pub widths: [usize; NUM_STAGES],
    /// Convolutions of each stage, without convolutions behind the last feature.
    pub convs: [usize; NUM_STAGES],
    /// Convolutions of each stage up to the feature, at least 1.
    pub taps: [usize; NUM_STAGES],
    /// Pooling between the stages.
    pub pooling: Pooling,
}

impl VggShape {
    /// VGG-16 with the features `relu1_2`, `relu2_2`, `relu3_3`, `relu4_3` and `relu5_3`.
    pub const VGG16: Self =
        Self { widths: [64, 128, 256, 512, 512], convs: [2, 2, 3, 3, 3], taps: [2, 2, 3, 3, 3], pooling: Pooling::Max };
    /// VGG-19 with average pooling and the features `relu1_2`, `relu2_2`, `relu3_2`, `relu4_2` and `relu5_2`.
    pub const VGG19: Self =
        Self { convs: [2, 2, 4, 4, 2], taps: [2, 2, 2, 2, 2], pooling: Pooling::Average, ..Self::VGG16 };
}

/// Cost of a network for one image, in f32 values and multiply-accumulates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VggSizes {
    pub parameters: f64,
    pub macs: f64,
    /// Output values of all convolutions and poolings.
    pub outputs: f64,
    /// Output values of the features.
    pub features: f64,
    /// Output values of the largest layer.
    pub widest: f64,
}

impl VggShape {
    /// Computes the cost of an image of `height` by `width` pixels.
    pub fn sizes(&self, height: usize, width: usize) -> VggSizes {
        let mut sizes = VggSizes { parameters: 0.0, macs: 0.0, outputs: 0.0, features: 0.0, widest: 0.0 };
        let mut inputs = 3.0;
        for (stage, (&count, &channels)) in self.convs.iter().zip(&self.widths).enumerate() {
            let pixels = ((height >> stage) * (width >> stage)) as f64;
            let values = channels as f64 * pixels;
            if stage > 0 {
                sizes.outputs += inputs * pixels;
            }
            for _ in 0..count {
                sizes.parameters += 9.0 * inputs * channels as f64 + channels as f64;
                sizes.macs += 9.0 * inputs * values;
                sizes.outputs += values;
                inputs = channels as f64;
            }
            sizes.features += values;
            sizes.widest = sizes.widest.max(values);
        }
        sizes
    }
}

/// A frozen network: weight `[outputs, inputs, 3, 3]` and bias of every convolution of every stage.
#[derive(Clone, Debug)]
pub struct Vgg {
    stages: Vec<Vec<(Tensor<4>, Tensor<1>)>>,
    shape: VggShape,
}

impl Vgg {
    /// Takes the tensors `convS_I.weight` and `convS_I.bias` out of a file.
    pub fn take(file: &mut NetworkFile, shape: VggShape, options: (&Device, DType)) -> Result<Self, ModelError> {
        let (mut stages, mut inputs) = (Vec::new(), 3);
        for (stage, (&count, &outputs)) in shape.convs.iter().zip(&shape.widths).enumerate() {
            let mut convs = Vec::new();
            for i in 1..=count {
                let name = format!("conv{}_{i}", stage + 1);
                let weight = file.take(&format!("{name}.weight"), [outputs, inputs, 3, 3], options)?;
                convs.push((weight, file.take(&format!("{name}.bias"), [outputs], options)?));
                inputs = outputs;
            }
            stages.push(convs);
        }
        Ok(Self { stages, shape })
    }

    /// # Shapes
    /// - `images`: `[batch, 3, height, width]`, both sides at least [`MIN_SIZE_PX`]
    /// - returns `[batch, channels, height / 2^s, width / 2^s]` for the stages s = 0 to 4
    pub fn features(&self, images: Tensor<4>) -> Vec<Tensor<4>> {
        let mut x = images;
        let mut features = Vec::new();
        for (stage, convs) in self.stages.iter().enumerate() {
            if stage > 0 {
                x = match self.shape.pooling {
                    Pooling::Max => max_pool2d(x, MaxPoolOptions::new([2, 2])),
                    Pooling::Average => avg_pool2d(x, AvgPoolOptions::new([2, 2])),
                }; // [B, C, H, W] -> [B, C, H/2, W/2]
            }
            for (i, (weight, bias)) in convs.iter().enumerate() {
                x = relu(convolution(x, weight.clone(), bias.clone()));
                if i + 1 == self.shape.taps[stage] {
                    features.push(x.clone());
                }
            }
        }
        features
    }
}

#[cfg(test)]
pub mod tests {
    use super::*;

    /// Channels of the narrow networks in the fixtures.
    pub const NARROW: [usize; NUM_STAGES] = [4, 6, 8, 8, 10];

    #[test]
    fn vgg16_has_its_published_size() {
        // Convolutions of VGG-16 without the classifier: 14,714,688 weights and 15.35e9 multiplications at 224 pixels.
        let sizes = VggShape::VGG16.sizes(224, 224);
        assert_eq!(sizes.parameters, 14_714_688.0);
        assert!((sizes.macs / 15.35e9 - 1.0).abs() < 1e-3, "{}", sizes.macs);
        // 122 values per pixel.
        assert_eq!((sizes.features, sizes.widest), (122.0 * 224.0 * 224.0, 64.0 * 224.0 * 224.0));
        // Pooling drops an odd last row.
        assert_eq!(VggShape::VGG16.sizes(17, 17).features, (64 * 17 * 17 + 128 * 64 + 256 * 16 + 512 * 4 + 512) as f64);
    }
}
