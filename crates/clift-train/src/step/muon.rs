//! Muon: momentum, then the nearest orthogonal matrix (<https://kellerjordan.github.io/posts/muon/>).
//!
//! Burn updates one parameter after the other, and the products of one small matrix are too small for several threads. Here
//! an update is two passes over the parameters. The first collects the gradients with momentum. Threads then orthogonalize
//! one matrix each, or a GPU all of a shape. The second pass applies the results.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use burn::module::{Module, ModuleVisitor, Param, ParamGroup, ParamId};
use burn::optim::lr_scheduler::module_lr_scheduler::ModuleLearningRate;
use burn::optim::momentum::{Momentum, MomentumConfig};
use burn::optim::{GradientsParams, LearningRate, ModuleOptimizer, MuonState, Optimizer};
use burn::tensor::{Device, Tensor};
use clift_model::matmul_without_gradient;
use rayon::prelude::*;

use crate::step::adamw::GradientFactor;

/// Coefficients of a Newton-Schulz step: `X <- (a + b X X^T + c (X X^T)^2) X`.
const COEFFICIENTS: [f32; 3] = [3.4445, -4.775, 2.0315];
const NEWTON_SCHULZ_STEPS: usize = 5;

/// Muon of one group of matrices.
#[derive(Clone)]
pub struct Muon {
    momentum: Momentum,
    weight_decay: f64,
    factor: GradientFactor,
    /// Gradients with momentum, while a pass collects them.
    collected: Arc<Mutex<Option<Vec<Tensor<2>>>>>,
}

impl Muon {
    pub fn new(weight_decay: f64, factor: GradientFactor) -> Self {
        let momentum = Momentum::new(&MomentumConfig { momentum: 0.95, dampening: 0.0, nesterov: true });
        Self { momentum, weight_decay, factor, collected: Arc::default() }
    }

    fn collected(&self) -> std::sync::MutexGuard<'_, Option<Vec<Tensor<2>>>> {
        self.collected.lock().expect("no pass panicked")
    }

    /// Updates the module: parameters of `group` by this optimizer, which `optimizer` has for the group, others as
    /// `optimizer` does.
    pub fn step<M: Module>(
        &self,
        (optimizer, group): (&mut ModuleOptimizer, &ParamGroup),
        rate: ModuleLearningRate,
        model: M,
        mut grads: GradientsParams,
    ) -> M {
        let (ids, of_group) = take_group(&model, group, &mut grads);
        *self.collected() = Some(Vec::new());
        let model = optimizer.step(rate.clone(), model, of_group);
        let collected = self.collected().take().unwrap_or_default();
        assert_eq!(collected.len(), ids.len(), "the optimizer updates every parameter of the group");
        for (id, update) in ids.into_iter().zip(orthogonalized(collected)) {
            grads.register(id, update);
        }
        optimizer.step(rate, model, grads)
    }
}

/// Removes the gradients of a group; returns them and the ids of their parameters in the order of the module.
fn take_group<M: Module>(
    model: &M,
    group: &ParamGroup,
    grads: &mut GradientsParams,
) -> (Vec<ParamId>, GradientsParams) {
    struct Taken<'a> {
        group: &'a ParamGroup,
        path: Vec<String>,
        from: &'a mut GradientsParams,
        ids: Vec<ParamId>,
        grads: GradientsParams,
    }
    impl ModuleVisitor for Taken<'_> {
        fn enter_module(&mut self, name: &str, _container_type: &str) {
            self.path.push(name.to_owned());
        }
        fn exit_module(&mut self, _name: &str, _container_type: &str) {
            self.path.pop();
        }
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            if !self.group.matches(&param.id, Some(&self.path.join("."))) {
                return;
            }
            if let Some(grad) = self.from.remove::<D>(param.id) {
                self.grads.register::<D>(param.id, grad);
                self.ids.push(param.id);
            }
        }
    }
    let mut taken = Taken { group, path: Vec::new(), from: grads, ids: Vec::new(), grads: GradientsParams::new() };
    model.visit(&mut taken);
    (taken.ids, taken.grads)
}

impl Optimizer for Muon {
    type State<const D: usize> = MuonState<D>;

    /// Collects the gradient with momentum and returns the tensor as it is, or applies an orthogonal update.
    fn step<const D: usize>(
        &self,
        rate: LearningRate,
        tensor: Tensor<D>,
        grad: Tensor<D>,
        state: Option<MuonState<D>>,
    ) -> (Tensor<D>, Option<MuonState<D>>) {
        assert_eq!(D, 2, "Muon updates matrices");
        let [rows, columns] = [tensor.dims()[0], tensor.dims()[1]];
        if let Some(collected) = self.collected().as_mut() {
            let (grad, momentum) = self.momentum.transform(self.factor.scale(grad), state.map(|state| state.momentum));
            collected.push(grad.reshape([rows, columns]));
            return (tensor, Some(MuonState::new(momentum)));
        }
        // The size of AdamW's updates, arXiv 2502.16982.
        let size = 0.2 * (rows.max(columns) as f64).sqrt();
        (tensor.mul_scalar(1.0 - rate * self.weight_decay) - grad.mul_scalar(rate * size), state)
    }

    fn to_device<const D: usize>(mut state: MuonState<D>, device: &Device) -> MuonState<D> {
        state.momentum = state.momentum.to_device(device);
        state
    }
}

/// Moves the singular values of matrices close to one: on the host every matrix by a thread, elsewhere equal shapes together.
fn orthogonalized(matrices: Vec<Tensor<2>>) -> Vec<Tensor<2>> {
    if matrices.iter().all(|matrix| matrix.device() == Device::flex()) {
        let one = |matrix: Tensor<2>| newton_schulz(matrix.unsqueeze()).squeeze_dim(0);
        return matrices.into_par_iter().map(one).collect();
    }
    let mut groups = BTreeMap::<[usize; 2], Vec<(usize, Tensor<2>)>>::new();
    for (i, matrix) in matrices.into_iter().enumerate() {
        groups.entry(matrix.dims()).or_default().push((i, matrix));
    }
    let mut results = BTreeMap::new();
    for group in groups.into_values() {
        let (numbers, matrices): (Vec<_>, Vec<_>) = group.into_iter().unzip();
        let matrices = newton_schulz(Tensor::stack(matrices, 0)).chunk(numbers.len(), 0);
        results.extend(numbers.into_iter().zip(matrices.into_iter().map(|matrix| matrix.squeeze_dim(0))));
    }
    results.into_values().collect()
}

/// Moves the singular values of matrices `[count, rows, columns]` close to one, by Newton-Schulz steps.
fn newton_schulz(matrices: Tensor<3>) -> Tensor<3> {
    let [count, rows, columns] = matrices.dims();
    let is_tall = rows > columns;
    let norm = matrices.clone().square().reshape([count, rows * columns]).sum_dim(1).sqrt().clamp_min(1e-7);
    let x = matrices.div(norm.reshape([count, 1, 1]));
    let mut x = if is_tall { x.swap_dims(1, 2) } else { x };
    let [a, b, c] = COEFFICIENTS;
    for _ in 0..NEWTON_SCHULZ_STEPS {
        let gram = matmul_without_gradient(x.clone(), x.clone().swap_dims(1, 2));
        let squared = matmul_without_gradient(gram.clone(), gram.clone());
        let factor = gram.mul_scalar(b).add(squared.mul_scalar(c));
        x = x.clone().mul_scalar(a).add(matmul_without_gradient(factor, x));
    }
    if is_tall { x.swap_dims(1, 2) } else { x }
}
