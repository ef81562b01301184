//! Gradients of an operation with a hand-written backward.

use burn::backend::Backend;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::Ops;
use burn::backend::tensor::FloatTensor;

/// Takes the gradient of an operation's output and registers the gradients of its inputs, which `gradients` computes from
/// the saved state. `gradients` receives one flag per input and may skip inputs without gradient.
pub(crate) fn register<B: Backend, S, const N: usize>(
    ops: Ops<S, N>,
    grads: &mut Gradients,
    gradients: impl FnOnce(S, FloatTensor<B>, [bool; N]) -> [Option<FloatTensor<B>>; N],
) where
    S: Clone + Send + std::fmt::Debug + 'static,
{
    let grad_output = grads.consume::<B>(&ops.node);
    let needed = ops.parents.each_ref().map(Option::is_some);
    for (parent, gradient) in ops.parents.into_iter().zip(gradients(ops.state, grad_output, needed)) {
        if let (Some(node), Some(gradient)) = (parent, gradient) {
            grads.register::<B>(node.id, gradient);
        }
    }
}
