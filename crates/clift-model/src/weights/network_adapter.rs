//! Weights of a smaller network for a larger one: with shorter patches, so that training goes on at a higher resolution with as
//! many tokens per view, or with fewer blocks.

use std::path::Path;

use burn::module::{Module, ModuleMapper, Param};
use burn::store::burn_pack::Tensor as PackTensor;
use burn::store::{ModuleAdapter, ModuleContext};
use burn::tensor::{Bytes, DType, Shape, Tensor};

use crate::error::ModelError;
use crate::network::architecture::Architecture;
use crate::network::config::ModelConfig;
use crate::views::rays::RayFrame;
use crate::weights::model_path::{check_equal_sizes, read_config};

/// Adapts the layers between pixels and tokens to patches `factor` times as long, and from rays in the frame of the scene to rays
/// in the frame of the camera, and adds blocks. The default changes nothing.
///
/// At first, the network sees the mean of every `factor` by `factor` pixels and repeats each pixel it renders as often. Rays in
/// the frame of the camera keep the weights of directions and lose those of moments, which changes the image until it is trained.
///
/// Added blocks follow those of the file. Their output layers are zero, so at first they change nothing
/// ([`close_added_blocks`](Self::close_added_blocks)).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NetworkAdapter {
    /// Side of the patches in the file, in pixels.
    patch_size: usize,
    factor: usize,
    rays: RayFrame,
    drops_moments: bool,
    /// Number of blocks of the encoder and of the renderer in the file, where the network has more.
    num_blocks: Option<[usize; 2]>,
}

impl Default for NetworkAdapter {
    fn default() -> Self {
        Self { patch_size: 1, factor: 1, rays: RayFrame::World, drops_moments: false, num_blocks: None }
    }
}

impl NetworkAdapter {
    /// Returns the adapter of the weights in `dir` to `model`, and checks that the networks have equal sizes otherwise. Groups of
    /// views may differ.
    ///
    /// # Errors
    /// [`ModelError::BadConfig`] with the first other size, [`ModelError::BadConfigFile`] for a config that cannot be read.
    pub fn find(model: &ModelConfig, dir: &Path) -> Result<Self, ModelError> {
        let Some(found) = read_config(dir)? else { return Ok(Self::default()) };
        let mut model = ModelConfig { group_size: found.group_size, ..model.clone() };
        let factor = model.patch_size / found.patch_size.max(1);
        let mut adapter = Self { patch_size: found.patch_size, rays: found.rays, ..Self::default() };
        if found.architecture == Architecture::Clift {
            if factor * found.patch_size == model.patch_size {
                adapter.factor = factor;
                adapter.drops_moments = found.rays == RayFrame::World && model.rays == RayFrame::Camera;
                model.patch_size = found.patch_size;
                model.rays = if adapter.drops_moments { found.rays } else { model.rays };
            }
            let num_blocks = |config: &ModelConfig| [config.num_encoder_blocks, config.num_renderer_blocks];
            let (blocks, former) = (num_blocks(&model), num_blocks(&found));
            if blocks != former && blocks[0] >= former[0] && blocks[1] >= former[1] {
                adapter.num_blocks = Some(former);
                [model.num_encoder_blocks, model.num_renderer_blocks] = former;
            }
        }
        check_equal_sizes(&model, &found, dir)?;
        let is_equal = adapter.factor == 1 && !adapter.drops_moments && adapter.num_blocks.is_none();
        Ok(if is_equal { Self::default() } else { adapter })
    }

    /// Describes the change; `None` without one.
    pub fn describe(&self) -> Option<String> {
        let Self { patch_size, factor, drops_moments, num_blocks, .. } = *self;
        let longer = (factor > 1).then(|| format!("patches of {} instead of {patch_size} pixels", factor * patch_size));
        let rays = drops_moments.then(|| "rays in the frame of the camera instead of the scene".into());
        let deeper = num_blocks.map(|[encoder, renderer]| format!("more than {encoder} + {renderer} blocks"));
        let changes: Vec<String> = longer.into_iter().chain(rays).chain(deeper).collect();
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

    /// Returns the values of a layer with longer patches.
    fn with_longer_patches(&self, name: &str, layer: Values) -> Values {
        // Linear weights are `[inputs, outputs]`.
        let (num_colors, rays, axis, scale) = match name {
            "encoder.patch_embed.weight" => (3, true, 0, 1.0 / (self.factor * self.factor) as f32),
            "renderer.ray_embed.weight" => (0, true, 0, 1.0 / (self.factor * self.factor) as f32),
            "renderer.to_pixels.weight" | "renderer.to_pixels.bias" => (3, false, 1, 1.0),
            _ => return layer,
        };
        let (expected_len, sources) = self.sources(num_colors, rays);
        // Another shape is an error of the file, with its own message.
        if layer.shape[axis] == expected_len { layer.gather(axis, &sources, scale) } else { layer }
    }

    /// Sets the output layers of added blocks to zero.
    pub fn close_added_blocks<M: Module>(&self, network: M) -> M {
        let Some(num_blocks) = self.num_blocks else { return network };
        network.map(&mut CloseBlocks { num_blocks, path: Vec::new() })
    }

    fn adapted(&self, tensor: &PackTensor) -> Option<PackTensor> {
        let shape = match tensor.shape[..] {
            [rows, columns] => [rows, columns],
            [columns] => [1, columns],
            _ => return None,
        };
        if tensor.dtype != DType::F32 {
            return None;
        }
        let bytes = tensor.to_bytes().ok()?;
        let value = |bytes: &[u8]| f32::from_le_bytes(bytes.try_into().expect("four bytes"));
        let layer = Values { shape, values: bytes.chunks_exact(4).map(value).collect() };
        let layer = self.with_longer_patches(&tensor.name, layer);
        let shape = Shape::from(layer.shape[2 - tensor.shape[..].len()..].to_vec());
        let values = Bytes::from_elems(layer.values);
        Some(PackTensor::new(tensor.name.clone(), DType::F32, shape, tensor.param_id, values))
    }
}

/// Sets the output layers of blocks from the numbers `num_blocks` on, of the encoder and of the renderer, to zero.
struct CloseBlocks {
    num_blocks: [usize; 2],
    path: Vec<String>,
}

impl CloseBlocks {
    fn is_closed(&self) -> bool {
        let [network, blocks, number, .., layer, _] = &self.path[..] else { return false };
        let former = match network.as_str() {
            "encoder" => self.num_blocks[0],
            "renderer" => self.num_blocks[1],
            _ => return false,
        };
        let is_added = blocks == "blocks" && number.parse().is_ok_and(|number: usize| number >= former);
        is_added && (layer == "out_proj" || layer == "down")
    }
}

impl ModuleMapper for CloseBlocks {
    fn enter_module(&mut self, name: &str, _kind: &str) {
        self.path.push(name.to_owned());
    }

    fn exit_module(&mut self, _name: &str, _kind: &str) {
        self.path.pop();
    }

    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        if self.is_closed() { param.map(|values| values.zeros_like()) } else { param }
    }
}

/// A matrix, or a row.
struct Values {
    shape: [usize; 2],
    values: Vec<f32>,
}

impl Values {
    /// Takes the rows (`axis` 0) or columns of `sources`, times `scale`.
    fn gather(self, axis: usize, sources: &[usize], scale: f32) -> Self {
        let Self { shape: [_, old_columns], values } = self;
        let mut shape = self.shape;
        shape[axis] = sources.len();
        let [rows, columns] = shape;
        let source = |row: usize, column: usize| match axis {
            0 => sources[row] * old_columns + column,
            _ => row * old_columns + sources[column],
        };
        let values = (0..rows * columns).map(|i| values[source(i / columns, i % columns)] * scale).collect();
        Self { shape, values }
    }
}

impl ModuleAdapter for NetworkAdapter {
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
            let adapter = NetworkAdapter::find(config, folder.path())?;
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

    #[test]
    fn deeper_networks_show_the_same_image() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.safetensors");
        let shallow = Network::new(&config(2, RayFrame::World), 3, &Device::flex());
        save_weights(&shallow, &path).unwrap();
        let text = "[model]\npatch_size = 2\ncamera_encoding = \"gta\"\ndim = 16\nnum_heads = 2\nfeed_forward_dim = 24\n\
                    num_encoder_blocks = 1\nnum_renderer_blocks = 1\n";
        std::fs::write(folder.path().join("config.toml"), text).unwrap();
        let deep = ModelConfig { num_encoder_blocks: 2, num_renderer_blocks: 3, ..config(2, RayFrame::World) };
        let mut network = Network::new(&deep, 4, &Device::flex());
        let adapter = NetworkAdapter::find(&deep, folder.path()).unwrap();
        assert_eq!(adapter.describe().as_deref(), Some("adapted to more than 1 + 1 blocks"));
        load_adapted(&mut network, &PathFilter::all(), &path, adapter).unwrap();
        let (context, targets) = views(2);
        let image = |network: &Network| network.render(network.encode(&context), &targets);
        let open = to_vec(image(&network) - image(&shallow));
        assert!(open.iter().any(|difference| difference.abs() > 1e-3));
        assert_close(&image(&adapter.close_added_blocks(network)), &image(&shallow), 0.0);
        let fewer = ModelConfig { num_encoder_blocks: 0, num_renderer_blocks: 3, ..config(2, RayFrame::World) };
        let wrong = NetworkAdapter::find(&fewer, folder.path()).unwrap_err().to_string();
        assert!(wrong.starts_with("`model.num_encoder_blocks` = 0: the weights are of a network with 1"), "{wrong}");
    }
}
