//! An operation with a hand-written backward as a node of the autodiff graph.

use std::fmt::Debug;
use std::marker::PhantomData;

use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend};

/// Gradients of the inputs; those that are not needed may be `None`.
pub(crate) type InputGrads<B, const N: usize> = [Option<FloatTensor<B>>; N];

/// An operation on `N` float tensors with its gradients. A value of the type has the settings, and tensors without gradient.
pub(crate) trait Differentiable<B: Backend, const N: usize>: Clone + Debug + Send + 'static {
    /// Tensors that the gradients are computed from.
    type Saved: Clone + Debug + Send + 'static;

    /// Computes the output. Where saving costs time, without it.
    fn forward(&self, inputs: [FloatTensor<B>; N]) -> FloatTensor<B> {
        self.forward_saving(inputs).0
    }

    /// Computes the output, and what the gradients need.
    fn forward_saving(&self, inputs: [FloatTensor<B>; N]) -> (FloatTensor<B>, Self::Saved);

    /// Computes the `needed` gradients from the gradient of the output.
    fn gradients(&self, saved: Self::Saved, grad: FloatTensor<B>, needed: [bool; N]) -> InputGrads<B, N>;
}

/// Computes the output of an operation under autodiff; saves for the backward only if an input needs a gradient.
#[expect(clippy::redundant_closure_for_method_calls, reason = "Burn does not export the type of the tensors")]
pub(crate) fn record<B: Backend, C: CheckpointStrategy, O: Differentiable<B, N>, const N: usize>(
    operation: O,
    inputs: [FloatTensor<Autodiff<B, C>>; N],
) -> FloatTensor<Autodiff<B, C>> {
    let nodes = inputs.each_ref().map(|input| input.node());
    let inputs = inputs.map(|input| input.into_primitive());
    match Node::<O>(PhantomData).prepare::<C>(nodes).compute_bound().stateful() {
        OpsKind::Tracked(prep) => {
            let (output, saved) = operation.forward_saving(inputs);
            prep.finish((operation, saved), output)
        }
        OpsKind::UnTracked(prep) => prep.finish(operation.forward(inputs)),
    }
}

#[derive(Debug)]
struct Node<O>(PhantomData<O>);

impl<B: Backend, O: Differentiable<B, N>, const N: usize> Backward<B, N> for Node<O> {
    type State = (O, O::Saved);

    fn backward(self, ops: Ops<Self::State, N>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        let grad_output = grads.consume::<B>(&ops.node);
        let needed = ops.parents.each_ref().map(Option::is_some);
        let (operation, saved) = ops.state;
        for (parent, gradient) in ops.parents.into_iter().zip(operation.gradients(saved, grad_output, needed)) {
            if let (Some(node), Some(gradient)) = (parent, gradient) {
                grads.register::<B>(node.id, gradient);
            }
        }
    }
}
