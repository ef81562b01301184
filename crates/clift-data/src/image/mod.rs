//! 8-bit images: decoding, resampling and cropping. `fit` is what a training frame passes through.
//!
//! - `rgb_image`: a decoded 8-bit RGB image
//! - `codec`: JPEG and PNG in and out
//! - `fit`: rescale and crop with intrinsics
//! - `lanczos`: Pillow's LANCZOS, bit for bit
//! - `undistort`: resample a distorted image

pub(crate) mod codec;
pub(crate) mod fit;
pub(crate) mod lanczos;
pub(crate) mod rgb_image;
pub(crate) mod undistort;
