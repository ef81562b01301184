//! Products, on `register_product` (f32) or `matrix_product` (cooperative matrices, f16), with an `epilogue`; `tiles` is the
//! table of their tiles. `convolution` is a product of im2col.

pub(crate) mod convolution;
pub(crate) mod epilogue;
pub(crate) mod matrix_product;
pub(crate) mod product;
pub(crate) mod product_kind;
pub(crate) mod register_product;
pub(crate) mod tiles;
