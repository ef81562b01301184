//! AdamW: Burn's, on GPUs by one kernel a parameter.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use burn::optim::{AdamWConfig, AdamWState, AdaptiveMomentumState, LearningRate, Optimizer};
use burn::tensor::{Device, Tensor};
use clift_model::{AdamWFactors, fused_adamw};

use crate::config::config::OptimizerConfig;

/// The released code's epsilon.
const EPSILON: f32 = 1e-8;

/// Factor of all gradients during an update, shared by the optimizers.
#[derive(Clone)]
pub struct GradientFactor(Arc<AtomicU64>);

impl Default for GradientFactor {
    fn default() -> Self {
        Self(Arc::new(AtomicU64::new(1.0_f64.to_bits())))
    }
}

impl GradientFactor {
    pub fn set(&self, factor: f64) {
        self.0.store(factor.to_bits(), Ordering::Relaxed);
    }

    pub fn get(&self) -> f64 {
        f64::from_bits(self.0.load(Ordering::Relaxed))
    }

    /// Multiplies a gradient.
    pub fn scale<const D: usize>(&self, grad: Tensor<D>) -> Tensor<D> {
        let factor = self.get();
        if factor == 1.0 { grad } else { grad.mul_scalar(factor) }
    }
}

/// AdamW of a config.
#[derive(Clone)]
pub struct AdamW {
    plain: burn::optim::AdamW,
    betas: [f32; 2],
    weight_decay: f32,
    factor: GradientFactor,
}

impl AdamW {
    pub fn new(config: &OptimizerConfig, factor: GradientFactor) -> Self {
        let (betas, weight_decay) = (config.betas.map(|beta| beta as f32), config.weight_decay as f32);
        let plain = AdamWConfig::new().with_beta_1(betas[0]).with_beta_2(betas[1]).with_epsilon(EPSILON);
        Self { plain: plain.with_weight_decay(weight_decay).build(), betas, weight_decay, factor }
    }
}

impl Optimizer for AdamW {
    type State<const D: usize> = AdamWState<D>;

    fn step<const D: usize>(
        &self,
        learning_rate: LearningRate,
        tensor: Tensor<D>,
        grad: Tensor<D>,
        state: Option<AdamWState<D>>,
    ) -> (Tensor<D>, Option<AdamWState<D>>) {
        if let Some(AdamWState { momentum }) = &state {
            let (betas, weight_decay, grad_factor) = (self.betas, self.weight_decay, self.factor.get() as f32);
            let time = momentum.time + 1;
            let factors = AdamWFactors { learning_rate, weight_decay, betas, epsilon: EPSILON, time, grad_factor };
            let tensors = [&tensor, &momentum.moment_1, &momentum.moment_2];
            if let Some([tensor, mean, square]) = fused_adamw(tensors, &grad, factors) {
                return (tensor, Some(AdamWState::new(AdaptiveMomentumState::new(time, mean, square))));
            }
        }
        self.plain.step(learning_rate, tensor, self.factor.scale(grad), state)
    }

    fn to_device<const D: usize>(state: AdamWState<D>, device: &Device) -> AdamWState<D> {
        burn::optim::AdamW::to_device(state, device)
    }
}
