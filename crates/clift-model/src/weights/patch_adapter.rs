//! Weights of a network with shorter patches, for a network with longer ones: training goes on at a higher resolution, with as
//! many tokens per view.

use std::path::Path;

use burn::store::burn_pack::Tensor as PackTensor;
use burn::store::{ModuleAdapter, ModuleContext};
use burn::tensor::{Bytes, DType, Shape};

use crate::error::ModelError;
use crate::network::architecture::Architecture;
use crate::network::config::ModelConfig;
use crate::views::rays::RayFrame;
use crate::weights::model_path::{check_equal_sizes, read_config};

/// Adapts the layers between pixels and tokens to patches `factor` times as long, and from rays in the frame of the scene to rays
/// in the frame of the camera. The default changes nothing.
///
/// At first, the network sees the mean of every `factor` by `factor` pixels and repeats each pixel it renders as often. Rays in
/// the frame of the camera keep the weights of directions and lose those of moments, which changes the image until it is trained.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PatchAdapter {
    /// Side of the patches in the file, in pixels.
    patch_size: usize,
    factor: usize,
    rays: RayFrame,
    drops_moments: bool,
}

impl Default for PatchAdapter {
    fn default() -> Self {
        Self { patch_size: 1, factor: 1, rays: RayFrame::World, drops_moments: false }
    }
}

impl PatchAdapter {
    /// Returns the adapter of the weights in `dir` to `model`, and checks that the networks have equal sizes otherwise. Groups of
    /// views may differ.
    ///
    /// # Errors
    /// [`ModelError::BadConfig`] with the first other size, [`ModelError::BadConfigFile`] for a config that cannot be read.
    pub fn find(model: &ModelConfig, dir: &Path) -> Result<Self, ModelError> {
        let Some(found) = read_config(dir)? else { return Ok(Self::default()) };
        let mut model = ModelConfig { group_size: found.group_size, ..model.clone() };
        let factor = model.patch_size / found.patch_size.max(1);
        let adapter = Self {
            patch_size: found.patch_size,
            factor,
            rays: found.rays,
            drops_moments: found.rays == RayFrame::World && model.rays == RayFrame::Camera,
        };
        let is_longer = factor * found.patch_size == model.patch_size && found.architecture == Architecture::Clift;
        if is_longer && (factor > 1 || adapter.drops_moments) {
            model.patch_size = found.patch_size;
            model.rays = if adapter.drops_moments { found.rays } else { model.rays };
            check_equal_sizes(&model, &found, dir)?;
            return Ok(adapter);
        }
        check_equal_sizes(&model, &found, dir)?;
        Ok(Self::default())
    }

    /// Describes the change; `None` without one.
    pub fn describe(&self) -> Option<String> {
        let Self { patch_size, factor, drops_moments, .. } = *self;
        let longer = (factor > 1).then(|| format!("patches of {} instead of {patch_size} pixels", factor * patch_size));
        let rays = drops_moments.then(|| "rays in the frame of the camera instead of the scene".into());
        let changes: Vec<String> = longer.into_iter().chain(rays).collect();
        (!changes.is_empty()).then(|| format!("adapted to {}", changes.join(" and ")))
    }

    /// Returns the length of a patch vector in the file, and which of its values each value of the longer vector comes from. A
    /// pixel has `num_colors` channels of colour, then the coordinates of its ray if there are `rays`.
    fn sources(&self, num_colors: usize, rays: bool) -> (usize, Vec<usize>) {
        let Self { patch_size, factor, drops_moments, .. } = *self;
        let num_coordinates = if rays { self.rays.num_coordinates() } else { 0 };
        let dropped = if rays && drops_moments { num_colors..num_colors + 3 } else { 0..0 };
        let channels = num_colors + num_coordinates;
        let kept = (0..channels).filter(|channel| !dropped.contains(channel));
        let side = 0..factor * patch_size;
        let pixels = side.clone().flat_map(|y| side.clone().map(move |x| (y / factor) * patch_size + x / factor));
        let sources = pixels.flat_map(|pixel| kept.clone().map(move |channel| pixel * channels + channel)).collect();
        (patch_size * patch_size * channels, sources)
    }

    fn adapted(&self, tensor: &PackTensor) -> Option<PackTensor> {
        // Linear weights are `[inputs, outputs]`.
        let (num_colors, rays, axis, scale) = match &*tensor.name {
            "encoder.patch_embed.weight" => (3, true, 0, 1.0 / (self.factor * self.factor) as f32),
            "renderer.ray_embed.weight" => (0, true, 0, 1.0 / (self.factor * self.factor) as f32),
            "renderer.to_pixels.weight" => (3, false, 1, 1.0),
            "renderer.to_pixels.bias" => (3, false, 0, 1.0),
            _ => return None,
        };
        let (expected_len, sources) = self.sources(num_colors, rays);
        let [rows, columns] = match tensor.shape[..] {
            [rows, columns] => [rows, columns],
            [rows] => [rows, 1],
            _ => return None,
        };
        let len = if axis == 0 { rows } else { columns };
        // Another shape is an error of the file, with its own message.
        if tensor.dtype != DType::F32 || len != expected_len {
            return None;
        }
        let bytes = tensor.to_bytes().ok()?;
        let values: Vec<f32> =
            bytes.chunks_exact(4).map(|bytes| f32::from_le_bytes(bytes.try_into().expect("four bytes"))).collect();
        let mut shape = tensor.shape[..].to_vec();
        shape[axis] = sources.len();
        let gathered: Vec<f32> = if axis == 0 {
            sources
                .iter()
                .flat_map(|&row| &values[row * columns..(row + 1) * columns])
                .map(|value| value * scale)
                .collect()
        } else {
            values.chunks_exact(columns).flat_map(|row| sources.iter().map(|&column| row[column])).collect()
        };
        let (name, shape) = (tensor.name.clone(), Shape::from(shape));
        Some(PackTensor::new(name, DType::F32, shape, tensor.param_id, Bytes::from_elems(gathered)))
    }
}

impl ModuleAdapter for PatchAdapter {
    fn adapt(&self, tensor: PackTensor, _context: ModuleContext<'_>) -> PackTensor {
        if *self == Self::default() {
            return tensor;
        }
        self.adapted(&tensor).unwrap_or(tensor)
    }

    fn clone_box(&self) -> Box<dyn ModuleAdapter> {
        Box::new(*self)
    }
}

#[cfg(test)]
mod tests {
    use burn::store::PathFilter;
    use burn::tensor::{Device, Tensor};
    use clift_core::{Camera, ClipViews, DMat3, Intrinsics, Pose};

    use super::*;
    use crate::network::architecture::CameraEncoding;
    use crate::network::model::Network;
    use crate::testing::{assert_close, random, to_vec};
    use crate::views::upload::{Cameras, Views};
    use crate::weights::file::{load_adapted, save_weights};

    fn config(patch_size: usize, rays: RayFrame) -> ModelConfig {
        ModelConfig {
            camera_encoding: CameraEncoding::Gta,
            rays,
            patch_size,
            dim: 16,
            num_heads: 2,
            feed_forward_dim: 24,
            num_encoder_blocks: 1,
            num_renderer_blocks: 1,
            ..ModelConfig::default()
        }
    }

    /// Returns two context views and a target of `4 * scale` by `8 * scale` pixels, whose colours are blocks of `scale` pixels.
    /// Rays are nearly parallel: the mean of four is the ray of their middle.
    fn views(scale: usize) -> (Views, Cameras) {
        let device = Device::flex();
        let [height, width] = [4 * scale, 8 * scale];
        let size = scale as f64;
        let camera = |index: usize| Camera {
            c2w: Pose {
                rotation: DMat3::from_rotation_y(0.02 * index as f64),
                translation: [0.3 * index as f64, 0.1, 0.0].into(),
            },
            intrinsics: Intrinsics { fx: 5e3 * size, fy: 6e3 * size, cx: 4.0 * size, cy: 2.0 * size },
        };
        let upload = |views: std::ops::Range<usize>| {
            let views = ClipViews {
                width,
                height,
                images: Vec::new(),
                cameras: views.clone().map(camera).collect(),
                frame_index: views.collect(),
            };
            Cameras::upload(&[&views], &device).expect("valid")
        };
        let blocks = random([2, 4, 8 * 3], 5, &device).reshape([1, 2, 4, 1, 8, 3]).cast(DType::F32);
        let images = blocks.reshape([1, 2, 4, 8, 3]);
        (Views { images: repeated(images, scale), cameras: upload(0..2) }, upload(2..3))
    }

    /// Repeats every pixel `scale` times along both sides.
    fn repeated(images: Tensor<5>, scale: usize) -> Tensor<5> {
        let [batch, views, height, width, channels] = images.dims();
        images
            .reshape([batch * views, height, 1, width, 1, channels])
            .expand([batch * views, height, scale, width, scale, channels])
            .reshape([batch, views, height * scale, width * scale, channels])
    }

    #[test]
    fn longer_patches_show_the_former_image_with_repeated_pixels() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.safetensors");
        let short = Network::new(&config(2, RayFrame::World), 3, &Device::flex());
        save_weights(&short, &path).unwrap();
        let write = |text: &str| std::fs::write(folder.path().join("config.toml"), text).unwrap();
        write(
            "[model]\npatch_size = 2\ncamera_encoding = \"gta\"\ndim = 16\nnum_heads = 2\nfeed_forward_dim = 24\n\
             num_encoder_blocks = 1\nnum_renderer_blocks = 1\n",
        );
        let load = |config: &ModelConfig| {
            let mut network = Network::new(config, 4, &Device::flex());
            let adapter = PatchAdapter::find(config, folder.path())?;
            load_adapted(&mut network, &PathFilter::all(), &path, adapter)?.require_all(&path)?;
            Ok::<_, ModelError>((network, adapter.describe()))
        };
        let render = |network: &Network, scale: usize| {
            let (context, targets) = views(scale);
            network.render(network.encode(&context), &targets)
        };
        let expected = render(&short, 1);
        for (factor, description) in [(1, None), (2, Some("adapted to patches of 4 instead of 2 pixels"))] {
            let (longer, described) = load(&config(2 * factor, RayFrame::World)).unwrap();
            assert_close(&render(&longer, factor), &repeated(expected.clone(), factor), 1e-4);
            assert_eq!(described.as_deref(), description);
        }
        // Without moments the image is another one, near it.
        let (of_cameras, described) = load(&config(4, RayFrame::Camera)).unwrap();
        let difference = to_vec(render(&of_cameras, 2) - repeated(expected, 2));
        assert!(difference.iter().all(|value| value.abs() < 0.2) && difference.iter().any(|value| value.abs() > 1e-4));
        assert!(described.unwrap().ends_with("pixels and rays in the frame of the camera instead of the scene"));
        let wrong = load(&config(3, RayFrame::World)).map(|_| ()).unwrap_err().to_string();
        assert!(wrong.starts_with("`model.patch_size` = 3: the weights are of a network with 2"), "{wrong}");
        // Weights with longer patches than their config says.
        save_weights(&Network::new(&config(4, RayFrame::World), 3, &Device::flex()), &path).unwrap();
        let other = load(&config(8, RayFrame::World)).map(|_| ()).unwrap_err().to_string();
        assert!(other.contains(" is [") && other.contains(", expected ["), "{other}");
        let wider = load(&ModelConfig { dim: 32, ..config(4, RayFrame::World) }).map(|_| ()).unwrap_err().to_string();
        assert!(wider.starts_with("`model.dim` = 32"), "{wider}");
    }
}
