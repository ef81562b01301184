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
use crate::weights::model_path::{check_equal_sizes, read_config};

/// Adapts the layers between pixels and tokens to longer patches, and adds blocks. The default changes nothing.
///
/// At first, the network sees the mean of every `factor` by `factor` pixels and repeats each pixel it renders as often.
///
/// Added blocks follow those of the file. Their output layers are zero, so at first they change nothing
/// ([`close_added_blocks`](Self::close_added_blocks)).
#[derive(Clone, Copy, Debug, Default)]
pub struct NetworkAdapter {
    /// Side of the patches in the file, in pixels, and the factor by which those of the network are longer.
    patches: Option<(usize, usize)>,
    /// Number of blocks of the encoder and of the renderer in the file, where the network has more.
    num_blocks: Option<[usize; 2]>,
}

impl NetworkAdapter {
    /// Returns the adapter of the weights in `dir` to `model`, and checks that the networks have equal sizes otherwise.
    pub fn find(model: &ModelConfig, dir: &Path) -> Result<Self, ModelError> {
        let Some(found) = read_config(dir)? else { return Ok(Self::default()) };
        let mut model = model.clone();
        let mut adapter = Self::default();
        if found.architecture == Architecture::Clift {
            let factor = model.patch_size / found.patch_size.max(1);
            if factor > 1 && factor * found.patch_size == model.patch_size {
                adapter.patches = Some((found.patch_size, factor));
                model.patch_size = found.patch_size;
            }
            let num_blocks = |config: &ModelConfig| [config.num_encoder_blocks, config.num_renderer_blocks];
            let (blocks, former) = (num_blocks(&model), num_blocks(&found));
            if blocks != former && blocks[0] >= former[0] && blocks[1] >= former[1] {
                adapter.num_blocks = Some(former);
                [model.num_encoder_blocks, model.num_renderer_blocks] = former;
            }
        }
        check_equal_sizes(&model, &found, dir)?;
        Ok(adapter)
    }

    /// Describes the change; `None` without one.
    pub fn describe(&self) -> Option<String> {
        let longer = |(side, factor)| format!("patches of {} instead of {side} pixels", factor * side);
        let deeper = |[encoder, renderer]: [usize; 2]| format!("more than {encoder} + {renderer} blocks");
        let changes: Vec<String> = self.patches.map(longer).into_iter().chain(self.num_blocks.map(deeper)).collect();
        (!changes.is_empty()).then(|| format!("adapted to {}", changes.join(" and ")))
    }

    /// Sets the output layers of added blocks to zero.
    pub fn close_added_blocks<M: Module>(&self, network: M) -> M {
        let Some(num_blocks) = self.num_blocks else { return network };
        network.map(&mut CloseBlocks { num_blocks, path: Vec::new() })
    }

    /// Returns a layer with longer patches; `None` for every other layer.
    fn with_longer_patches(&self, tensor: &PackTensor) -> Option<PackTensor> {
        let (patch_size, factor) = self.patches?;
        // Linear weights are `[inputs, outputs]`.
        let (axis, scale) = match tensor.name.as_str() {
            "encoder.patch_embed.weight" | "renderer.ray_embed.weight" => (0, 1.0 / (factor * factor) as f32),
            "renderer.to_pixels.weight" | "renderer.to_pixels.bias" => (1, 1.0),
            _ => return None,
        };
        let [rows, columns] = match tensor.shape[..] {
            [rows, columns] => [rows, columns],
            [columns] => [1, columns],
            _ => return None,
        };
        if tensor.dtype != DType::F32 {
            return None;
        }
        let bytes = tensor.to_bytes().ok()?;
        let value = |bytes: &[u8]| f32::from_le_bytes(bytes.try_into().expect("four bytes"));
        let former: Vec<f32> = bytes.chunks_exact(4).map(value).collect();

        // Every pixel of the longer patch takes the channels of the pixel of the former patch that it lies in.
        let channels = [rows, columns][axis] / (patch_size * patch_size);
        let side = 0..factor * patch_size;
        let pixels = side.clone().flat_map(|y| side.clone().map(move |x| (y / factor) * patch_size + x / factor));
        let sources: Vec<usize> = pixels.flat_map(|pixel| pixel * channels..(pixel + 1) * channels).collect();
        let (rows, source): (usize, &dyn Fn(usize, usize) -> usize) = match axis {
            0 => (sources.len(), &|row, column| sources[row] * columns + column),
            _ => (rows, &|row, column| row * columns + sources[column]),
        };
        let columns = if axis == 0 { columns } else { sources.len() };
        let values = (0..rows * columns).map(|i| former[source(i / columns, i % columns)] * scale).collect();
        let shape = [rows, columns][2 - tensor.shape[..].len()..].to_vec();
        let values = Bytes::from_elems::<f32>(values);
        Some(PackTensor::new(tensor.name.clone(), DType::F32, Shape::from(shape), tensor.param_id, values))
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

impl ModuleAdapter for NetworkAdapter {
    fn adapt(&self, tensor: PackTensor, _context: ModuleContext<'_>) -> PackTensor {
        self.with_longer_patches(&tensor).unwrap_or(tensor)
    }

    fn clone_box(&self) -> Box<dyn ModuleAdapter> {
        Box::new(*self)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use burn::store::PathFilter;
    use burn::tensor::{Device, Tensor};
    use clift_core::{Camera, DMat3, Intrinsics, Pose};

    use super::*;
    use crate::network::architecture::CameraEncoding;
    use crate::network::model::Network;
    use crate::testing::{assert_close, random, to_vec};
    use crate::views::upload::{Cameras, Views};
    use crate::weights::file::{load_adapted, save_weights};

    fn config(patch_size: usize) -> ModelConfig {
        ModelConfig { camera_encoding: CameraEncoding::Gta, patch_size, ..ModelConfig::small() }
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
            Cameras::of_views(&views.map(camera).collect::<Vec<_>>(), height, width, &device).expect("valid")
        };
        let images = random([2, 4, 8 * 3], 5, &device).reshape([1, 2, 4, 8, 3]).cast(DType::F32);
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
    fn larger_networks_show_the_former_image_with_repeated_pixels() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.safetensors");
        let former = Network::new(&config(2), 3, &Device::flex());
        save_weights(&former, &path).unwrap();
        let text = toml::to_string(&BTreeMap::from([("model", config(2))])).unwrap();
        std::fs::write(folder.path().join("config.toml"), text).unwrap();
        let load = |config: &ModelConfig| {
            let mut network = Network::new(config, 4, &Device::flex());
            let adapter = NetworkAdapter::find(config, folder.path())?;
            load_adapted(&mut network, &PathFilter::all(), &path, adapter)?;
            Ok::<_, ModelError>((network, adapter))
        };
        let render = |network: &Network, scale: usize| {
            let (context, targets) = views(scale);
            network.render(network.encode(&context), &targets)
        };
        let deeper = |patch_size| ModelConfig { num_encoder_blocks: 2, num_renderer_blocks: 3, ..config(patch_size) };
        for (config, factor, description) in [
            (config(2), 1, None),
            (config(4), 2, Some("adapted to patches of 4 instead of 2 pixels")),
            (deeper(2), 1, Some("adapted to more than 1 + 1 blocks")),
            (deeper(4), 2, Some("adapted to patches of 4 instead of 2 pixels and more than 1 + 1 blocks")),
        ] {
            let (network, adapter) = load(&config).unwrap();
            assert_eq!(adapter.describe().as_deref(), description);
            let expected = repeated(render(&former, 1), factor);
            let added = to_vec(render(&network, factor) - expected.clone());
            let is_deeper = config.num_renderer_blocks > 1;
            assert_eq!(added.iter().any(|difference| difference.abs() > 1e-3), is_deeper, "added blocks are open");
            assert_close(&render(&adapter.close_added_blocks(network), factor), &expected, 1e-4);
        }

        let refused = |config: &ModelConfig| load(config).map(|_| ()).unwrap_err().to_string();
        let wrong = refused(&config(3));
        assert!(wrong.starts_with("`model.patch_size` = 3: the weights are of a network with 2"), "{wrong}");
        let wrong = refused(&ModelConfig { num_encoder_blocks: 0, ..deeper(2) });
        assert!(wrong.starts_with("`model.num_encoder_blocks` = 0: the weights are of a network with 1"), "{wrong}");
        let wider = refused(&ModelConfig { dim: 32, ..config(4) });
        assert!(wider.starts_with("`model.dim` = 32"), "{wider}");
        // Weights with longer patches than their config says.
        save_weights(&Network::new(&config(4), 3, &Device::flex()), &path).unwrap();
        let other = refused(&config(8));
        assert!(other.contains(" is [") && other.contains(", expected ["), "{other}");
    }
}
