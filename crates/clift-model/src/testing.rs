//! Devices, fixtures, gradient checks and comparisons for the unit tests.

use std::cell::Cell;
use std::path::{Path, PathBuf};

use burn::tensor::{DType, Device, Tensor, TensorData};
use clift_kernels::InstructionSet;
use safetensors::{Dtype, SafeTensors};

use crate::device::name::DeviceName;
use crate::network::architecture::{Architecture, CliftVariant};
use crate::network::config::{CondenserConfig, ModelConfig};
use crate::views::upload::Cameras;

/// Opens the CPU devices of this build, which support f64. The suite `wgpu_suite` compares wgpu with them.
pub fn devices() -> Vec<Device> {
    let names = [DeviceName::Flex, DeviceName::Ndarray].into_iter().filter(|name| name.is_built());
    names.map(|name| name.open().expect("a CPU device")).collect()
}

/// Returns a small network of a variant; all sizes differ.
pub fn small_config(variant: CliftVariant) -> ModelConfig {
    ModelConfig {
        variant,
        dim: 15,
        num_heads: 3,
        feed_forward_dim: 22,
        num_encoder_blocks: 1,
        num_renderer_blocks: 3,
        patch_size: 8,
        condenser: CondenserConfig::of(variant),
        ..ModelConfig::default()
    }
}

pub fn small_lvsm() -> ModelConfig {
    let condenser = CondenserConfig::NONE;
    let clift = small_config(CliftVariant::Paper);
    ModelConfig { architecture: Architecture::LvsmEd, num_latents: 7, condenser, ..clift }
}

/// Returns [`small_config`] of all variants, and of the paper without residuals, and [`small_lvsm`].
pub fn small_configs() -> Vec<ModelConfig> {
    let mut literal = small_config(CliftVariant::Paper);
    literal.condenser.residual = false;
    CliftVariant::ALL.map(small_config).into_iter().chain([literal, small_lvsm()]).collect()
}

pub fn to_vec<const D: usize>(tensor: Tensor<D>) -> Vec<f64> {
    tensor.into_data().convert::<f64>().try_to_vec::<f64>().expect("f64 after conversion")
}

/// Returns the largest absolute difference, relative to the largest absolute expected value.
pub fn relative_error<const D: usize>(got: &Tensor<D>, expected: &Tensor<D>) -> f64 {
    assert_eq!(got.dims(), expected.dims(), "shapes differ");
    let (got, expected) = (to_vec(got.clone()), to_vec(expected.clone()));
    assert!(got.iter().all(|value| value.is_finite()), "the result is not finite");
    let scale = expected.iter().fold(0.0_f64, |scale, value| scale.max(value.abs())).max(f64::MIN_POSITIVE);
    got.iter().zip(&expected).fold(0.0_f64, |error, (a, b)| error.max((a - b).abs())) / scale
}

/// Asserts that two tensors are equal to `tolerance` of the largest expected value.
#[track_caller]
pub fn assert_close<const D: usize>(got: &Tensor<D>, expected: &Tensor<D>, tolerance: f64) {
    let error = relative_error(got, expected);
    assert!(error <= tolerance, "relative error {error:.3e} above {tolerance:.1e}");
}

/// One file of `data-fixtures/reference`, written by `scripts/fixtures/make_fixtures.py`.
pub struct Fixture {
    bytes: Vec<u8>,
}

impl Fixture {
    pub fn open(name: &str) -> Self {
        Self::read(&Self::path(name))
    }

    pub fn read(path: &Path) -> Self {
        Self { bytes: std::fs::read(path).unwrap_or_else(|error| panic!("{error}: {}", path.display())) }
    }

    pub fn path(name: &str) -> PathBuf {
        PathBuf::from(env!("CARGO_MANIFEST_DIR")).join(format!("../../data-fixtures/reference/{name}.safetensors"))
    }

    /// Returns the names of all tensors that start with `prefix`, without the prefix.
    pub fn names(&self, prefix: &str) -> Vec<String> {
        let file = SafeTensors::deserialize(&self.bytes).expect("a fixture is valid");
        file.names().into_iter().filter_map(|name| name.strip_prefix(prefix)).map(String::from).collect()
    }

    pub fn tensor<const D: usize>(&self, name: &str, device: &Device) -> Tensor<D> {
        Tensor::from_data(self.data(name), (device, DType::F32))
    }

    pub fn tensor_f64<const D: usize>(&self, name: &str, device: &Device) -> Tensor<D> {
        Tensor::from_data(self.data(name), (device, DType::F64))
    }

    /// Returns the cameras of the tensors `input.{prefix}c2w` and `input.{prefix}intrinsics`, of 24 columns and 16 rows.
    pub fn cameras(&self, prefix: &str, device: &Device, dtype: DType) -> Cameras {
        let data = |name: &str| self.data(&format!("input.{prefix}{name}"));
        let c2w = Tensor::from_data(data("c2w"), (device, dtype));
        let intrinsics = Tensor::from_data(data("intrinsics"), (device, dtype));
        Cameras { height: 16, width: 24, c2w, intrinsics }
    }

    pub fn integers(&self, name: &str) -> Vec<i64> {
        self.data(name).try_to_vec().expect("a tensor of i64")
    }

    pub fn f64s(&self, name: &str) -> Vec<f64> {
        self.data(name).convert::<f64>().try_to_vec().expect("f64 after conversion")
    }

    pub fn f32s(&self, name: &str) -> Vec<f32> {
        self.data(name).convert::<f32>().try_to_vec().expect("f32 after conversion")
    }

    pub fn shape(&self, name: &str) -> Vec<usize> {
        self.data(name).shape().to_vec()
    }

    pub fn data(&self, name: &str) -> TensorData {
        let file = SafeTensors::deserialize(&self.bytes).expect("a fixture is valid");
        let view = file.tensor(name).unwrap_or_else(|error| panic!("{name}: {error}"));
        let dtype = match view.dtype() {
            Dtype::F32 => DType::F32,
            Dtype::F64 => DType::F64,
            Dtype::I64 => DType::I64,
            other => panic!("{name} is {other:?}"),
        };
        TensorData::from_bytes_vec(view.data().to_vec(), view.shape(), dtype)
    }
}

/// Samples uniform values in `[-1, 1)` from a seed, equal on every device; f64 on CPU devices, f32 on others.
pub fn random<const D: usize>(shape: [usize; D], seed: u64, device: &Device) -> Tensor<D> {
    use rand::{RngExt, SeedableRng};
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let values: Vec<f64> = (0..shape.iter().product()).map(|_| rng.random_range(-1.0..1.0)).collect();
    let dtype = if device.supports_dtype(DType::F64) { DType::F64 } else { DType::F32 };
    Tensor::from_data(TensorData::new(values, shape), (device, dtype))
}

/// Returns the output of `f` and the gradients of the inputs under a cotangent; zeros for an input without a gradient.
pub fn output_and_gradients<const COUNT: usize>(
    inputs: [Tensor<3>; COUNT],
    cotangent: Tensor<3>,
    f: impl Fn([Tensor<3>; COUNT]) -> Tensor<3>,
) -> (Tensor<3>, [Tensor<3>; COUNT]) {
    let tracked = inputs.map(|input| input.autodiff().require_grad());
    let output = f(tracked.clone());
    let grads = (output.clone() * cotangent.autodiff()).sum().backward();
    let gradients = tracked.map(|input| input.grad(&grads).unwrap_or_else(|| input.inner().zeros_like()));
    (output.inner(), gradients)
}

#[track_caller]
pub fn assert_finite<const COUNT: usize>(grads: [Tensor<3>; COUNT]) {
    assert!(grads.into_iter().all(|grad| grad.is_finite().all().into_scalar::<bool>()));
}

thread_local! {
    /// Instruction set of native kernels that this thread calls, in place of the widest.
    pub static INSTRUCTION_SET: Cell<Option<InstructionSet>> = const { Cell::new(None) };
}

/// Asserts that output and gradients of `f` in f32, by native kernels of flex with every instruction set of this machine in
/// turn, equal the results in f64 (composed operations), to `tolerance` of the largest entry. Gradients that are zero in f64
/// are zero to `tolerance`.
#[track_caller]
pub fn check_native<const COUNT: usize>(
    inputs: [Tensor<3>; COUNT],
    f: impl Fn([Tensor<3>; COUNT]) -> Tensor<3>,
    tolerance: f64,
) {
    let inputs = inputs.map(|input| input.cast(DType::F32));
    let wide = inputs.clone().map(|input| input.cast(DType::F64));
    let cotangent = random(f(wide.clone()).dims(), 99, &inputs[0].device()).cast(DType::F32);
    let (expected, expected_grads) = output_and_gradients(wide, cotangent.clone().cast(DType::F64), &f);
    for set in InstructionSet::available() {
        INSTRUCTION_SET.set(Some(set));
        let (output, grads) = output_and_gradients(inputs.clone(), cotangent.clone(), &f);
        assert_close(&output.cast(DType::F64), &expected, tolerance);
        for (grad, expected) in grads.into_iter().zip(&expected_grads) {
            if expected.clone().abs().max().into_scalar::<f64>() > 1e-12 {
                assert_close(&grad.cast(DType::F64), expected, tolerance);
            } else {
                assert!(grad.abs().max().into_scalar::<f32>() < tolerance as f32, "a gradient of zero");
            }
        }
    }
    INSTRUCTION_SET.set(None);
}

/// Asserts that the gradients of `f` under a random cotangent equal central differences in f64, to `tolerance` of the
/// largest entry.
///
/// The step of 1e-5 causes an error of about 1e-10 from the third derivative and 1e-11 from rounding.
#[track_caller]
pub fn check_gradients<const COUNT: usize>(
    inputs: [Tensor<3>; COUNT],
    f: impl Fn([Tensor<3>; COUNT]) -> Tensor<3>,
    tolerance: f64,
) {
    let cotangent = random(f(inputs.clone()).dims(), 99, &inputs[0].device());
    let (_, gradients) = output_and_gradients(inputs.clone(), cotangent.clone(), &f);
    let loss = |inputs: [Tensor<3>; COUNT]| to_vec((f(inputs) * cotangent.clone()).sum())[0];
    let step = 1e-5;
    for (position, gradient) in gradients.into_iter().enumerate() {
        let analytic = to_vec(gradient);
        let shape = inputs[position].dims();
        let values = to_vec(inputs[position].clone());
        let moved = |index: usize, by: f64| {
            let mut values = values.clone();
            values[index] += by;
            let mut inputs = inputs.clone();
            inputs[position] =
                Tensor::from_data(TensorData::new(values, shape), (&inputs[position].device(), DType::F64));
            loss(inputs)
        };
        let numeric: Vec<f64> =
            (0..values.len()).map(|index| (moved(index, step) - moved(index, -step)) / (2.0 * step)).collect();
        let scale = numeric.iter().fold(0.0_f64, |scale, value| scale.max(value.abs()));
        for (index, (a, n)) in analytic.iter().zip(&numeric).enumerate() {
            assert!((a - n).abs() <= tolerance * scale, "input {position}, entry {index}: {a} against {n}");
        }
    }
}

/// Loads the tensors of a fixture whose names start with `prefix` into a module, in PyTorch's layout; asserts that every
/// tensor is used and none is missing.
pub fn load_weights<M: burn::module::Module>(mut module: M, fixture: &Fixture, prefix: &str) -> M {
    use burn::store::{ModuleSnapshot, PyTorchToBurnAdapter, SafetensorsStore};
    let mut store = SafetensorsStore::from_bytes(Some(fixture.bytes.clone()))
        .with_from_adapter(PyTorchToBurnAdapter)
        .with_key_remapping(format!("^{prefix}"), "")
        .allow_partial(true);
    let result = module.load_from(&mut store).expect("the fixture loads");
    assert!(result.missing.is_empty(), "missing in the fixture: {:?}", result.missing);
    assert_eq!(result.applied.len(), fixture.names(prefix).len(), "every weight of the fixture is used");
    module
}

/// Asserts that the gradient of every parameter of a module equals the fixture's.
#[track_caller]
pub fn weight_gradients<M: burn::module::Module>(
    module: &M,
    grads: &burn::tensor::Gradients,
    fixture: &Fixture,
    prefix: &str,
    tolerance: f64,
) {
    for (path, [got, expected]) in gradient_pairs(module, grads, fixture, prefix) {
        let error = relative_error(&got, &expected);
        assert!(error <= tolerance, "{path}: relative error {error:.3e} above {tolerance:.1e}");
    }
}

/// Returns the norm of the difference and the norm of the second of every pair.
pub fn error_norms(pairs: &[[Tensor<1>; 2]]) -> [f64; 2] {
    let norm = |values: &mut dyn Iterator<Item = Vec<f64>>| values.flatten().map(|x| x * x).sum::<f64>().sqrt();
    let difference = |[got, expected]: &[Tensor<1>; 2]| {
        to_vec(got.clone()).into_iter().zip(to_vec(expected.clone())).map(|(a, b)| a - b).collect()
    };
    [norm(&mut pairs.iter().map(difference)), norm(&mut pairs.iter().map(|[_, expected]| to_vec(expected.clone())))]
}

/// Returns the gradient of every parameter of a module beside the fixture's, flat, with the parameter's path.
#[track_caller]
pub fn gradient_pairs<M: burn::module::Module>(
    module: &M,
    grads: &burn::tensor::Gradients,
    fixture: &Fixture,
    prefix: &str,
) -> Vec<(String, [Tensor<1>; 2])> {
    use burn::module::{ModuleVisitor, Param};
    struct Compare<'a> {
        grads: &'a burn::tensor::Gradients,
        fixture: &'a Fixture,
        prefix: &'a str,
        path: Vec<String>,
        pairs: Vec<(String, [Tensor<1>; 2])>,
    }
    impl ModuleVisitor for Compare<'_> {
        fn enter_module(&mut self, name: &str, _container: &str) {
            self.path.push(name.into());
        }

        fn exit_module(&mut self, _name: &str, _container: &str) {
            self.path.pop();
        }

        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            let path = self.path.join(".").replace("gamma", "weight").replace("beta", "bias");
            let name = format!("{}{path}", self.prefix);
            let got = param.val().grad(self.grads).unwrap_or_else(|| panic!("{path} has no gradient"));
            let expected: Tensor<D> = self.fixture.tensor(&name, &got.device());
            // PyTorch stores linear weights as [outputs, inputs].
            let expected = if D == 2 { expected.swap_dims(0, 1) } else { expected };
            self.pairs.push((path, [got, expected].map(|x| x.reshape([-1]))));
        }
    }
    let mut compare = Compare { grads, fixture, prefix, path: Vec::new(), pairs: Vec::new() };
    module.visit(&mut compare);
    assert_eq!(compare.pairs.len(), fixture.names(prefix).len(), "every gradient of the fixture is compared");
    compare.pairs
}
