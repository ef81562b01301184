//! AdamW and Muon, global gradient norm and clipping.

use burn::module::{Module, ModuleVisitor, Param, ParamGroup};
use burn::optim::lr_scheduler::module_lr_scheduler::ModuleLearningRate;
use burn::optim::{
    DynOptimizer, DynState, GradientsParams, LearningRate, ModuleOptimizer, OptimizerRecord, StateSink, StateSource,
};
use burn::tensor::kind::BridgeTensor;
use burn::tensor::{Device, Tensor};
use clift_model::fused_gradient_norm;

use crate::config::config::{Algorithm, OptimizerConfig};
use crate::step::adamw::{AdamW, GradientFactor};
use crate::step::muon::Muon;

/// The optimizer of a stage: AdamW, and, if the config names Muon, Muon for the weight matrices of the transformer blocks.
/// Weight decay applies to every parameter.
///
/// Muon's updates are scaled to the size of AdamW's (`0.2 sqrt(max(rows, columns))`, arXiv 2502.16982), so that both
/// optimizers share learning rate and weight decay.
#[derive(Clone)]
pub struct StageOptimizer {
    all: ModuleOptimizer,
    muon: Option<(Muon, ParamGroup)>,
    factor: GradientFactor,
}

impl StageOptimizer {
    /// Makes the optimizer of a config, without state. Loaded state is placed on `device`.
    pub fn new(config: &OptimizerConfig, device: &Device) -> Self {
        let factor = GradientFactor::default();
        let adamw = AdamW::new(config, factor.clone());
        let on_device = OnDevice { optimizer: adamw.clone(), device: device.clone().inner() };
        let all = ModuleOptimizer::from(adamw).with_group(ParamGroup::all(), on_device, None);
        match config.algorithm {
            Algorithm::Adamw => Self { all, muon: None, factor },
            Algorithm::Muon => {
                let matrices = ParamGroup::from_regex(r"(^|\.)blocks\..*\.weight$").expect("a valid pattern");
                let muon = Muon::new(f64::from(config.weight_decay as f32), factor.clone());
                let on_device = OnDevice { optimizer: muon.clone(), device: device.clone().inner() };
                Self { all: all.with_group(matrices.clone(), on_device, None), muon: Some((muon, matrices)), factor }
            }
        }
    }

    /// Updates the parameters of a module that have gradients, by `factor` times the gradients.
    pub fn step<M: Module>(
        &mut self,
        rate: impl Into<ModuleLearningRate>,
        model: M,
        grads: GradientsParams,
        factor: f64,
    ) -> M {
        self.factor.set(factor);
        let Self { all, muon, .. } = self;
        match muon {
            Some((muon, matrices)) => muon.step((all, matrices), rate.into(), model, grads),
            None => all.step(rate, model, grads),
        }
    }

    /// Returns the state of all parameters.
    pub fn to_record(&self) -> OptimizerRecord {
        self.all.to_record()
    }

    /// Replaces the state of all parameters.
    ///
    /// # Panics
    /// For integer tensors and for tensors without parameter ids, in Burn 0.22.
    #[must_use]
    pub fn load_record(self, record: OptimizerRecord) -> Self {
        Self { all: self.all.load_record(record), ..self }
    }
}

/// An optimizer whose loaded state is placed on `device`. Burn loads state on its default device, which is the GPU in a build
/// with `wgpu`, also for a run on the CPU.
struct OnDevice<O> {
    optimizer: O,
    device: Device,
}

impl<O: DynOptimizer> DynOptimizer for OnDevice<O> {
    fn step_dyn(
        &self,
        rank: usize,
        rate: LearningRate,
        tensor: BridgeTensor,
        grad: BridgeTensor,
        state: Option<DynState>,
    ) -> (BridgeTensor, Option<DynState>) {
        self.optimizer.step_dyn(rank, rate, tensor, grad, state)
    }

    fn to_device_dyn(&self, state: DynState, device: &Device) -> DynState {
        self.optimizer.to_device_dyn(state, device)
    }

    fn state_flatten(&self, prefix: &str, state: &DynState, out: &mut StateSink) {
        self.optimizer.state_flatten(prefix, state, out);
    }

    fn state_unflatten(
        &self,
        rank: usize,
        prefix: &str,
        source: &mut StateSource,
        _default: &Device,
    ) -> Option<DynState> {
        self.optimizer.state_unflatten(rank, prefix, source, &self.device)
    }
}

/// Returns the norm of all gradients of a module, `[1]`, on their device; `None` without gradients.
pub fn norm_on_device<M: Module>(module: &M, grads: &GradientsParams) -> Option<Tensor<1>> {
    struct Squares<'a> {
        grads: &'a GradientsParams,
        /// Sums of squares, on the CPU.
        sums: Vec<Tensor<1>>,
        /// Gradients on other devices.
        others: Vec<Tensor<1>>,
    }
    impl ModuleVisitor for Squares<'_> {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            if let Some(grad) = self.grads.get::<D>(param.id) {
                if grad.device() == Device::flex() {
                    self.sums.push(grad.square().sum());
                } else {
                    self.others.push(grad.flatten(0, D - 1));
                }
            }
        }
    }
    let mut squares = Squares { grads, sums: Vec::new(), others: Vec::new() };
    module.visit(&mut squares);
    let Squares { mut sums, others, .. } = squares;
    fused_gradient_norm(&others).or_else(|| {
        sums.extend(others.into_iter().map(|grad| grad.square().sum()));
        (!sums.is_empty()).then(|| Tensor::cat(sums, 0).sum().sqrt())
    })
}

/// Returns the factor that clips gradients of a global norm to `max_norm`.
pub fn clip_factor(norm: f64, max_norm: f64) -> f64 {
    // PyTorch's guard against a norm of zero.
    (max_norm / (norm + 1e-6)).min(1.0)
}

#[cfg(test)]
mod tests {
    use burn::optim::{AdamWConfig, AdamWState};
    use burn::tensor::TensorData;

    use super::*;
    use crate::testing::Reference;

    #[derive(Module, Debug)]
    struct Toy {
        a: Param<Tensor<2>>,
        b: Param<Tensor<1>>,
    }

    fn assert_close<const D: usize>(got: Tensor<D>, expected: Tensor<D>, tolerance: f32) {
        let difference = (got - expected).abs().max().into_scalar::<f32>();
        assert!(difference <= tolerance, "{difference:e}");
    }

    fn toy(fixture: &Reference, device: &Device) -> Toy {
        Toy {
            a: Param::from_tensor(fixture.tensor("input.param_a", device)),
            b: Param::from_tensor(fixture.tensor("input.param_b", device)),
        }
    }

    #[test]
    fn state_is_loaded_on_the_device_of_the_run() {
        let device = clift_model::DeviceName::Ndarray.open().expect("a build for tests");
        assert_ne!(Device::default(), device, "on which Burn would load it");
        let mut source = StateSource::new([("1.momentum.time".to_owned(), 3_usize.into())].into());
        for moment in ["moment_1", "moment_2"] {
            source.insert_tensor(format!("1.momentum.{moment}"), TensorData::from([1.0_f32, 2.0]));
        }
        let optimizer = OnDevice { optimizer: AdamWConfig::new().build(), device: device.clone() };
        let state = optimizer.state_unflatten(1, "1", &mut source, &Device::default()).expect("a whole state");
        assert_eq!(state.downcast::<AdamWState<1>>().momentum.moment_2.device(), device);
    }

    #[test]
    fn five_updates_equal_pytorch() {
        let fixture = Reference::open("reference/adamw");
        let device = Device::flex();
        // Parameters that train live with autodiff, their gradients without.
        let mut model = toy(&fixture, &device.clone().autodiff());
        let mut optimizer = StageOptimizer::new(&OptimizerConfig::default(), &device);
        let grads_a: Tensor<3> = fixture.tensor("input.grad_a", &device);
        let grads_b: Tensor<2> = fixture.tensor("input.grad_b", &device);
        for (step, rate) in fixture.values("output.lr").into_iter().take(5).enumerate() {
            let mut grads = GradientsParams::new();
            grads.register(model.a.id, grads_a.clone().narrow(0, step, 1).squeeze_dim::<2>(0));
            grads.register(model.b.id, grads_b.clone().narrow(0, step, 1).squeeze_dim::<1>(0));
            model = optimizer.step(rate, model, grads, 1.0);
            // f32 against f64 for parameters of about one.
            let expected = fixture.tensor::<3>("output.param_a", &device).narrow(0, step, 1);
            assert_close(model.a.val().inner(), expected.squeeze_dim::<2>(0), 1e-6);
            let expected = fixture.tensor::<2>("output.param_b", &device).narrow(0, step, 1);
            assert_close(model.b.val().inner(), expected.squeeze_dim::<1>(0), 1e-6);
        }
    }

    /// Weight matrices of transformer blocks, and one outside of them.
    #[derive(Module, Debug)]
    struct Matrices {
        blocks: Vec<Block>,
        outside: Block,
    }

    #[derive(Module, Debug)]
    struct Block {
        layer: Weight,
    }

    #[derive(Module, Debug)]
    struct Weight {
        weight: Param<Tensor<2>>,
    }

    #[test]
    fn five_updates_of_muon_equal_the_definition_in_f64() {
        check_muon(&Device::flex());
        // `wgpu_suite` reports a machine without an adapter.
        match clift_model::DeviceName::Wgpu.open() {
            Ok(device) => check_muon(&device),
            Err(error) if clift_model::DeviceName::Wgpu.is_built() => {
                assert!(std::env::var_os("CLIFT_REQUIRE_WGPU").is_none(), "{error}");
            }
            Err(_) => {}
        }
    }

    fn check_muon(device: &Device) {
        let fixture = Reference::open("reference/muon");
        let rate = fixture.values("output.lr")[0];
        let block = |name: &str| {
            let weight = fixture.tensor(&format!("input.param_{name}"), &device.clone().autodiff());
            Block { layer: Weight { weight: Param::from_tensor(weight) } }
        };
        let names = ["wide", "tall", "wide"];
        let mut model = Matrices { blocks: vec![block("wide"), block("tall")], outside: block("wide") };
        let config = OptimizerConfig { algorithm: Algorithm::Muon, ..OptimizerConfig::default() };
        let mut optimizer = StageOptimizer::new(&config, device);
        for step in 0..5 {
            let of_step = |kind: &str, name: &str| {
                let all: Tensor<3> = fixture.tensor(&format!("{kind}_{name}"), device);
                all.narrow(0, step, 1).squeeze_dim::<2>(0)
            };
            let weights = |model: &Matrices| {
                let blocks = [&model.blocks[0], &model.blocks[1], &model.outside];
                blocks.map(|block| block.layer.weight.clone())
            };
            let mut grads = GradientsParams::new();
            for (weight, name) in weights(&model).iter().zip(names) {
                grads.register(weight.id, of_step("input.grad", name));
            }
            model = optimizer.step(rate, model, grads, 1.0);
            let [wide, tall, outside] = weights(&model).map(|weight| weight.val().inner());
            assert_close(wide.clone(), of_step("output.param", "wide"), 2e-6);
            assert_close(tall, of_step("output.param", "tall"), 2e-6);
            assert!((wide - outside).abs().max().into_scalar::<f32>() > 1e-3, "AdamW updates it");
        }
    }

    #[test]
    fn clipping_equals_pytorch() {
        let fixture = Reference::open("reference/adamw");
        let device = Device::flex();
        let model = toy(&fixture, &device);
        for case in ["large", "small"] {
            let mut grads = GradientsParams::new();
            grads.register(model.a.id, fixture.tensor::<2>(&format!("input.clip_{case}_a"), &device));
            grads.register(model.b.id, fixture.tensor::<1>(&format!("input.clip_{case}_b"), &device));
            let norm = norm_on_device(&model, &grads).expect("gradients").into_scalar::<f64>();
            let expected = fixture.tensor::<1>(&format!("output.clip_{case}_norm"), &device).into_scalar::<f64>();
            assert!((norm / expected - 1.0).abs() < 1e-6, "{norm} against {expected}");
            let factor = GradientFactor::default();
            factor.set(clip_factor(norm, 1.0));
            let got = factor.scale(grads.get::<2>(model.a.id).expect("kept"));
            assert_close(got, fixture.tensor(&format!("output.clip_{case}_a"), &device), 1e-6);
            let got = factor.scale(grads.get::<1>(model.b.id).expect("kept"));
            assert_close(got, fixture.tensor(&format!("output.clip_{case}_b"), &device), 1e-6);
        }
    }
}
