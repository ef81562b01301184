//! Metrics of images, and the networks that measure them: PSNR, SSIM, sharpness, LPIPS, and the perceptual loss.
//!
//! - `image_metrics`: PSNR, SSIM and sharpness
//! - `vgg`: VGG-16 and VGG-19 features
//! - `network_file`: converted VGG weights, read strictly
//! - `lpips`: LPIPS
//! - `perceptual`: perceptual training loss

pub(crate) mod image_metrics;
pub(crate) mod lpips;
pub(crate) mod network_file;
pub(crate) mod perceptual;
pub(crate) mod vgg;
