//! Muon: momentum, then the nearest orthogonal matrix (<https://kellerjordan.github.io/posts/muon/>).
//!
//! Burn updates one parameter after the other, and the products of one small matrix are too small for several threads. Here
//! an update is two passes over the parameters. The first collects the gradients with momentum. Threads then orthogonalize
//! one matrix each. The second pass applies the results.

use std::sync::{Arc, Mutex};

use burn::module::{Module, ModuleVisitor, Param, ParamGroup, ParamId};
use burn::optim::lr_scheduler::module_lr_scheduler::ModuleLearningRate;
use burn::optim::momentum::{Momentum, MomentumConfig};
use burn::optim::{GradientsParams, LearningRate, ModuleOptimizer, MuonState, Optimizer};
use burn::tensor::{Device, Tensor};
use rayon::prelude::*;

/// Coefficients of a Newton-Schulz step: `X <- (a + b X X^T + c (X X^T)^2) X`.
const COEFFICIENTS: [f32; 3] = [3.4445, -4.775, 2.0315];
const NEWTON_SCHULZ_STEPS: usize = 5;

/// Muon of one group of matrices.
#[derive(Clone)]
pub struct Muon {
    momentum: Momentum,
    weight_decay: f64,
    /// Gradients with momentum, while a pass collects them.
    collected: Arc<Mutex<Option<Vec<Tensor<2>>>>>,
}

impl Muon {
    pub fn new(weight_decay: f64) -> Self {
        let momentum = Momentum::new(&MomentumConfig { momentum: 0.95, dampening: 0.0, nesterov: true });
        Self { momentum, weight_decay, collected: Arc::default() }
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
        let on_host = collected.iter().all(|grad| grad.device() == Device::flex());
        let updates: Vec<Tensor<2>> = if on_host {
            collected.into_par_iter().map(orthogonalized).collect()
        } else {
            collected.into_iter().map(orthogonalized).collect()
        };
        for (id, update) in ids.into_iter().zip(updates) {
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
            let (grad, momentum) = self.momentum.transform(grad, state.map(|state| state.momentum));
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

/// Moves the singular values of a matrix close to one, by Newton-Schulz steps.
fn orthogonalized(matrix: Tensor<2>) -> Tensor<2> {
    let [rows, columns] = matrix.dims();
    let is_tall = rows > columns;
    let x = if is_tall { matrix.transpose() } else { matrix };
    let norm = x.clone().square().sum().sqrt().clamp_min(1e-7);
    let mut x = x.div(norm.unsqueeze());
    let [a, b, c] = COEFFICIENTS;
    for _ in 0..NEWTON_SCHULZ_STEPS {
        let gram = x.clone().matmul(x.clone().transpose());
        let squared = gram.clone().matmul(gram.clone());
        let factor = gram.mul_scalar(b).add(squared.mul_scalar(c));
        x = x.clone().mul_scalar(a).add(factor.matmul(x));
    }
    if is_tall { x.transpose() } else { x }
}
