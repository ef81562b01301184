//! 8-bit images: decoding, resampling and cropping. `fit` is what a training frame passes through.
//!
//! - `codec`: JPEG and PNG in and out
//! - `fit`: rescale and crop with intrinsics
//! - `jpeg_scan`: damage in the middle of a JPEG file
//! - `lanczos`: Pillow's LANCZOS, bit for bit
//! - `undistort`: resample a distorted image

pub(crate) mod codec;
pub(crate) mod fit;
pub(crate) mod jpeg_scan;
pub(crate) mod lanczos;
pub(crate) mod undistort;
