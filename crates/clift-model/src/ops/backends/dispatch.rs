//! The list of backends: an operation runs on the backend of its tensors.

#[cfg(feature = "ndarray")]
impl crate::ops::kernels::Kernels for burn::backend::NdArray {}

/// Declares a trait of operations `fn name(inputs; arguments) = operation` and implements it for every backend with
/// [`Kernels`](crate::ops::kernels::Kernels), for autodiff on such a backend, and for [`Dispatch`](burn::backend::Dispatch),
/// which selects the backend at run time. Inputs and results are float tensors; `operation` is a
/// [`Differentiable`](crate::ops::autodiff::Differentiable).
macro_rules! operations {
    ($(#[$attribute:meta])* pub trait $trait:ident {
        $(fn $name:ident($($input:ident),+; $($argument:ident: $type:ident $(<$of:tt>)?),*) = $operation:expr;)+
    }) => {
        $(#[$attribute])*
        #[burn::backend::backend_extension(
            Flex, NdArray: cfg(feature = "ndarray"), Cube: cfg(feature = "wgpu"), Autodiff
        )]
        pub trait $trait: burn::backend::Backend {
            $(fn $name(
                $($input: burn::backend::tensor::FloatTensor<Self>,)+
                $($argument: $type $(<$of>)?),*
            ) -> burn::backend::tensor::FloatTensor<Self>;)+
        }

        impl<B: $crate::ops::kernels::Kernels> $trait for B {
            $(fn $name(
                $($input: burn::backend::tensor::FloatTensor<Self>,)+
                $($argument: $type $(<$of>)?),*
            ) -> burn::backend::tensor::FloatTensor<Self> {
                $crate::ops::autodiff::Differentiable::<Self, _>::forward(&$operation, [$($input),+])
            })+
        }

        impl<B, C> $trait for burn::backend::Autodiff<B, C>
        where
            B: $crate::ops::kernels::Kernels,
            C: burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy,
        {
            $(fn $name(
                $($input: burn::backend::tensor::FloatTensor<Self>,)+
                $($argument: $type $(<$of>)?),*
            ) -> burn::backend::tensor::FloatTensor<Self> {
                $crate::ops::autodiff::record::<B, C, _, _>($operation, [$($input),+])
            })+
        }
    };
}

pub(crate) use operations;
