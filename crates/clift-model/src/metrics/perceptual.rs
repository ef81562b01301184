//! The perceptual term of the training loss: VGG-19 with average pooling (paper section 3.3).
// B scenes, V views, C channels, H rows, W columns

use std::path::Path;

use burn::tensor::{DType, Device, Tensor, TensorData};

use crate::error::ModelError;
use crate::metrics::network_file::{NetworkFile, WeightFileSpec};
use crate::metrics::vgg::{MIN_SIZE_PX, Vgg, VggShape};

/// Smallest side of an image, in pixels.
pub const PERCEPTUAL_MIN_SIZE_PX: usize = MIN_SIZE_PX;

/// Command that makes the weight file.
pub const PERCEPTUAL_COMMAND: &str =
    "python3 scripts/tools/convert_vgg.py vgg19 imagenet-vgg-verydeep-19.mat -o vgg19.safetensors";

const WANTED: WeightFileSpec =
    WeightFileSpec { what: "the perceptual loss", format: "clift-vgg19-1", command: PERCEPTUAL_COMMAND };

/// Mean colour of the network's training images, out of 255.
const MEAN_RGB: [f32; 3] = [123.68, 116.779, 103.939];

/// Factors of the mean absolute differences, per feature.
const FACTORS: [f64; 5] = [1.0 / 2.6, 1.0 / 4.8, 1.0 / 3.7, 1.0 / 5.6, 10.0 / 1.5];

/// The perceptual loss with its frozen network.
#[derive(Clone, Debug)]
pub struct Perceptual {
    vgg: Vgg,
    /// `[1, 3, 1, 1]`
    mean: Tensor<4>,
    sha256: String,
}

impl Perceptual {
    /// Reads the weights, which are constants of the loss, to a device without autodiff.
    pub fn load(path: &Path, device: &Device) -> Result<Self, ModelError> {
        Self::with_shape(path, VggShape::VGG19, (device, DType::F32))
    }

    fn with_shape(path: &Path, shape: VggShape, options: (&Device, DType)) -> Result<Self, ModelError> {
        let mut file = NetworkFile::read(path, WANTED)?;
        let vgg = Vgg::take(&mut file, shape, options)?;
        let mean = Tensor::<1>::from_data(TensorData::new(MEAN_RGB.to_vec(), [3]), options).reshape([1, 3, 1, 1]);
        Ok(Self { vgg, mean, sha256: file.finish()? })
    }

    /// Returns the SHA-256 of the weight file, 64 hexadecimal digits.
    pub fn sha256(&self) -> &str {
        &self.sha256
    }

    /// Returns the weighted mean absolute differences of the images and of five features, over 255.
    ///
    /// Identical images have zero gradient, since the gradient at a difference of exactly zero is zero.
    ///
    /// # Shapes
    /// - `rendering`, `target`: `[batch, views, height, width, 3]` in `[0, 1]`, both sides at least 16 pixels; the
    ///   target gets no gradient
    /// - returns a scalar, `[1]`
    pub fn forward(&self, rendering: Tensor<5>, target: Tensor<5>) -> Tensor<1> {
        let target = self.features(target.detach());
        let rendering = self.features(rendering);
        let difference = |(rendering, target): (Tensor<4>, Tensor<4>)| (rendering - target).abs().mean();
        let mut pairs = rendering.into_iter().zip(target);
        let first = difference(pairs.next().expect("features start with the images"));
        let sum = pairs.zip(FACTORS).fold(first, |sum, (pair, factor)| sum + difference(pair).mul_scalar(factor));
        // A multiplication, since Burn rounds the gradient of a division by a scalar to f32.
        sum.mul_scalar(1.0 / 255.0)
    }

    /// Returns the images in the units of the network and the features, `[B V, C, H, W]` each.
    fn features(&self, images: Tensor<5>) -> Vec<Tensor<4>> {
        let [batch, views, height, width, 3] = images.dims() else { panic!("images have three channels") };
        let images = images.reshape([batch * views, height, width, 3]).permute([0, 3, 1, 2]);
        let input = images.mul_scalar(255.0) - self.mean.clone();
        let mut features = vec![input.clone()];
        features.extend(self.vgg.features(input));
        features
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::name::DeviceName;
    use crate::metrics::vgg::tests::NARROW;
    use crate::testing::{Fixture, devices, to_vec};

    fn narrow(options: (&Device, DType)) -> Perceptual {
        let shape = VggShape { widths: NARROW, ..VggShape::VGG19 };
        Perceptual::with_shape(&Fixture::path("perceptual_weights"), shape, options).unwrap()
    }

    fn loss_and_grad(loss: &Perceptual, rendering: Tensor<5>, target: Tensor<5>) -> (f64, Vec<f64>) {
        let rendering = rendering.autodiff().require_grad();
        let loss = loss.forward(rendering.clone(), target.autodiff());
        let grads = loss.backward();
        (to_vec(loss.inner())[0], to_vec(rendering.grad(&grads).expect("the rendering is tracked")))
    }

    /// Checks loss and gradient. Rounding can flip the sign of a difference near zero, and change an entry of the
    /// gradient. In f32 its tolerance is therefore relative to the largest entry.
    fn check_fixture(loss: &Perceptual, fixture: &Fixture, options: (&Device, DType), tolerances: [f64; 2]) {
        let tensor = |name: &str| Tensor::from_data(fixture.data(name), options);
        let (loss, grad) = loss_and_grad(loss, tensor("input.rendering"), tensor("input.target"));
        let (expected, expected_grad) = (fixture.f64s("output.loss")[0], fixture.f64s("grad.input.rendering"));
        assert!((loss - expected).abs() <= tolerances[0] * expected, "{loss} is not {expected}");
        assert_eq!(grad.len(), expected_grad.len());
        let scale = expected_grad.iter().fold(0.0_f64, |scale, value| scale.max(value.abs()));
        let error = grad.iter().zip(expected_grad).fold(0.0_f64, |most, (a, b)| most.max((a - b).abs())) / scale;
        assert!(error <= tolerances[1], "{options:?}: {error:.2e}");
        println!("loss {loss} for {expected}, largest error of the gradient {error:.2e} of its largest entry");
    }

    #[test]
    fn loss_and_gradient_equal_pytorch() {
        let fixture = Fixture::open("perceptual");
        for device in devices() {
            for (dtype, tolerance) in [(DType::F64, 1e-9), (DType::F32, 1e-4)] {
                let options = (&device, dtype);
                check_fixture(&narrow(options), &fixture, options, [tolerance * 0.1, tolerance]);
            }
        }
        // `wgpu_suite` reports a machine without an adapter.
        match DeviceName::Wgpu.open() {
            Ok(device) => {
                let options = (&device, DType::F32);
                check_fixture(&narrow(options), &fixture, options, [1e-5, 1e-4]);
            }
            Err(error) if DeviceName::Wgpu.is_built() => {
                assert!(std::env::var_os("CLIFT_REQUIRE_WGPU").is_none(), "{error}");
            }
            Err(_) => {}
        }
    }

    #[test]
    fn identical_images_have_zero_loss_and_gradient() {
        for device in devices() {
            let loss = narrow((&device, DType::F32));
            let flat = |value: f32| Tensor::<5>::full([1, 2, 16, 18, 3], value, &device);
            for (a, b) in [(0.0, 0.0), (0.5, 0.5), (0.0, 1.0), (1.0, 0.0)] {
                let (value, grad) = loss_and_grad(&loss, flat(a), flat(b));
                assert!(value.is_finite() && grad.iter().all(|value| value.is_finite()), "{a} {b}");
                assert_eq!(value == 0.0, a == b);
                assert_eq!(grad.iter().all(|&value| value == 0.0), a == b, "{a} {b}");
            }
        }
    }

    /// `scripts/check/check_vgg.py` writes the folder.
    #[test]
    #[ignore = "needs the files of scripts/check/check_vgg.py"]
    fn the_full_network_equals_pytorch() {
        let folder = std::path::PathBuf::from(std::env::var("CLIFT_CHECK_VGG").expect("the folder of check_vgg.py"));
        let device = Device::flex();
        let loss = Perceptual::load(&folder.join("vgg19.safetensors"), &device).unwrap();
        let fixture = Fixture::read(&folder.join("perceptual.safetensors"));
        check_fixture(&loss, &fixture, (&device, DType::F32), [1e-4, 1e-3]);
    }
}
