//! LPIPS with VGG-16, version 0.1: perceptual distance of two images (arXiv 1801.03924).
// C channels, H rows, W columns

use std::path::Path;

use burn::tensor::{DType, Device, Tensor, TensorData};

use crate::error::ModelError;
use crate::metrics::image_metrics::{check_images, check_size};
use crate::metrics::network_file::{NetworkFile, WeightFileSpec};
use crate::metrics::vgg::{MIN_SIZE_PX, NUM_STAGES, Vgg, VggShape};

/// Smallest side of an image, in pixels.
pub const LPIPS_MIN_SIZE_PX: usize = MIN_SIZE_PX;

/// Command that makes the weight file.
pub const LPIPS_COMMAND: &str =
    "python3 scripts/tools/convert_vgg.py lpips vgg16-397923af.pth lpips/weights/v0.1/vgg.pth -o lpips-vgg.safetensors";

const WANTED: WeightFileSpec = WeightFileSpec { what: "LPIPS", format: "clift-lpips-vgg-1", command: LPIPS_COMMAND };

/// Mean of the network's inputs, for values in [-1, 1].
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];

/// Added to the norm of a position, which is zero without activation.
const MIN_NORM: f64 = 1e-10;

/// The metric with its weights. Equals `LPIPS(net="vgg")(.., normalize=True)` of the `lpips` package.
#[derive(Clone, Debug)]
pub struct Lpips {
    vgg: Vgg,
    /// Weight of every channel, per stage, `[1, C, 1, 1]`.
    heads: Vec<Tensor<4>>,
    device: Device,
    sha256: String,
}

/// Features of an image: unit vectors along the channels, per stage, `[1, C, H, W]`.
#[derive(Clone, Debug)]
pub struct LpipsFeatures(Vec<Tensor<4>>);

impl Lpips {
    /// Reads the weights.
    pub fn load(path: &Path, device: &Device) -> Result<Self, ModelError> {
        Self::with_shape(path, VggShape::VGG16, (device, DType::F32))
    }

    fn with_shape(path: &Path, shape: VggShape, options: (&Device, DType)) -> Result<Self, ModelError> {
        let mut file = NetworkFile::read(path, WANTED)?;
        let vgg = Vgg::take(&mut file, shape, options)?;
        let head = |(stage, channels): (usize, usize)| {
            let head = file.take(&format!("head{}.weight", stage + 1), [channels], options)?;
            Ok(head.reshape([1, channels, 1, 1]))
        };
        let heads = shape.widths.into_iter().enumerate().map(head).collect::<Result<_, ModelError>>()?;
        Ok(Self { vgg, heads, device: options.0.clone(), sha256: file.finish()? })
    }

    /// Returns the SHA-256 of the weight file, 64 hexadecimal digits.
    pub fn sha256(&self) -> &str {
        &self.sha256
    }

    /// Computes the features of an image, `[height, width, 3]` in `[0, 1]`; other values are not clamped.
    pub fn features(&self, image: &[f32], height: usize, width: usize) -> Result<LpipsFeatures, ModelError> {
        check_images(image, image, height * width * 3)?;
        check_size("LPIPS", LPIPS_MIN_SIZE_PX, height, width)?;
        let pixels = TensorData::new(image.to_vec(), [1, height, width, 3]);
        let dtype = self.heads[0].dtype();
        let pixels = Tensor::<4>::from_data(pixels, (&self.device, dtype)).permute([0, 3, 1, 2]); // [1, 3, H, W]
        let channel = |values: [f32; 3]| Tensor::<1>::from_data(values, (&self.device, dtype)).reshape([1, 3, 1, 1]);
        let input = (pixels * 2.0 - 1.0 - channel(SHIFT)) / channel(SCALE);
        let unit = |feature: Tensor<4>| {
            let norm = feature.clone().square().sum_dim(1).sqrt() + MIN_NORM;
            feature / norm
        };
        Ok(LpipsFeatures(self.vgg.features(input).into_iter().map(unit).collect()))
    }

    /// Returns the distance of two images of the same size; 0 for identical images.
    pub fn distance(&self, a: &LpipsFeatures, b: &LpipsFeatures) -> Result<f64, ModelError> {
        let stages = (0..NUM_STAGES).map(|stage| {
            let squared = (a.0[stage].clone() - b.0[stage].clone()).square() * self.heads[stage].clone();
            squared.sum_dim(1).mean() // over positions
        });
        let sum = stages.reduce(|sum, mean| sum + mean).expect("NUM_STAGES is 5").into_data().convert::<f64>();
        Ok(sum.try_to_vec::<f64>().map_err(ModelError::device)?[0])
    }

    /// Returns the distance of two images, `[height, width, 3]`.
    pub fn measure(&self, pred: &[f32], target: &[f32], height: usize, width: usize) -> Result<f64, ModelError> {
        self.distance(&self.features(pred, height, width)?, &self.features(target, height, width)?)
    }
}

impl LpipsFeatures {
    /// Returns the memory of the features in bytes.
    pub fn num_bytes(&self) -> usize {
        self.0.iter().map(|stage| stage.dims().iter().product::<usize>() * size_of::<f32>()).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::metrics::vgg::tests::NARROW;
    use crate::testing::{Fixture, devices};

    fn narrow(device: &Device) -> Lpips {
        let path = Fixture::path("lpips_weights");
        Lpips::with_shape(&path, VggShape { widths: NARROW, ..VggShape::VGG16 }, (device, DType::F32)).unwrap()
    }

    fn check_fixture(lpips: &Lpips, fixture: &Fixture, tolerance: f64) {
        let mut most = 0.0_f64;
        let pairs = fixture.names("output.lpips.");
        assert!(!pairs.is_empty(), "an empty fixture checks nothing");
        for pair in pairs {
            let shape = fixture.shape(&format!("input.target.{pair}"));
            let [height, width, 3] = shape[..] else { panic!("{shape:?}") };
            let image = |kind: &str| fixture.f32s(&format!("input.{kind}.{pair}"));
            let (pred, target) = (image("prediction"), image("target"));
            let distance = lpips.measure(&pred, &target, height, width).unwrap();
            let expected = fixture.f64s(&format!("output.lpips.{pair}"))[0];
            let error = (distance - expected).abs();
            assert!(error <= tolerance, "{pair}: {distance} is not {expected}");
            most = most.max(error);
        }
        println!("largest error of LPIPS {most:.1e}");
    }

    #[test]
    fn narrow_networks_equal_pytorch() {
        let fixture = Fixture::open("lpips");
        for device in devices() {
            // Distances are 0.01 to 1; 13 layers in f32 have a relative error of 1e-6.
            check_fixture(&narrow(&device), &fixture, 1e-5);
        }
    }

    /// `scripts/check/check_vgg.py` writes the folder: full network, heads and distances of the package.
    #[test]
    #[ignore = "needs the files of scripts/check/check_vgg.py"]
    fn the_full_network_equals_the_lpips_package() {
        let folder = std::path::PathBuf::from(std::env::var("CLIFT_CHECK_VGG").expect("the folder of check_vgg.py"));
        let lpips = Lpips::load(&folder.join("lpips-vgg.safetensors"), &Device::flex()).unwrap();
        check_fixture(&lpips, &Fixture::read(&folder.join("lpips.safetensors")), 1e-5);
    }

    #[test]
    fn bad_images_and_weights_are_errors() {
        let lpips = narrow(&Device::flex());
        let message = lpips.measure(&[0.5; 15 * 40 * 3], &[0.5; 15 * 40 * 3], 15, 40).unwrap_err().to_string();
        assert_eq!(message, "LPIPS needs at least 16 x 16 pixels, got 40 x 15");
        assert!(lpips.measure(&[f32::NAN; 16 * 16 * 3], &[0.5; 16 * 16 * 3], 16, 16).is_err());
        for (file, part) in [("lpips_weights", "conv1_1.weight has shape"), ("perceptual_weights", "clift-vgg19-1")] {
            let message = Lpips::load(&Fixture::path(file), &Device::flex()).unwrap_err().to_string();
            assert!(message.contains(part) && message.contains("convert_vgg.py lpips"), "{message}");
        }
    }
}
