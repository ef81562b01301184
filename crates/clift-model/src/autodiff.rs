//! What our own differentiable operations share.

use burn::backend::Backend;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::Ops;
use burn::backend::tensor::FloatTensor;

/// Takes the gradient of an operation's output, computes those of its inputs from the saved state, and
/// hands them to the inputs that want one.
pub(crate) fn register<B: Backend, S, const N: usize>(
    ops: Ops<S, N>,
    grads: &mut Gradients,
    gradients: impl FnOnce(S, FloatTensor<B>) -> [FloatTensor<B>; N],
) where
    S: Clone + Send + std::fmt::Debug + 'static,
{
    let grad_output = grads.consume::<B>(&ops.node);
    for (parent, gradient) in ops.parents.into_iter().zip(gradients(ops.state, grad_output)) {
        if let Some(node) = parent {
            grads.register::<B>(node.id, gradient);
        }
    }
}
