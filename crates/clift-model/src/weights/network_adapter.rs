//! Weights of a smaller network for a larger one: with shorter patches, so that training goes on at a higher resolution with as
//! many tokens per view, of less width, or with fewer blocks.

use std::path::Path;

use burn::module::{Module, ModuleMapper, Param};
use burn::store::burn_pack::Tensor as PackTensor;
use burn::store::{ModuleAdapter, ModuleContext};
use burn::tensor::{Bytes, DType, Shape, Tensor};

use clift_core::mix;

use crate::error::ModelError;
use crate::network::architecture::Architecture;
use crate::network::config::ModelConfig;
use crate::weights::model_path::{check_equal_sizes, read_config};

/// Adapts the layers between pixels and tokens to longer patches, and adds channels and blocks. The default changes nothing.
///
/// At first, the network sees the mean of every `factor` by `factor` pixels and repeats each pixel it renders as often.
///
/// Added channels are zero at first: nothing writes to them, and random weights read them. Added heads and hidden values of feed-
/// forward layers have random inputs and no outputs. The weights of norms make up for the zeros in the variance, exactly if the
/// mean over the channels is zero.
///
/// Added blocks follow those of the file. Their output layers are zero, so at first they change nothing
/// ([`close_added_blocks`](Self::close_added_blocks)).
#[derive(Clone, Copy, Debug, Default)]
pub struct NetworkAdapter {
    /// Side of the patches in the file, in pixels, and the factor by which those of the network are longer.
    patches: Option<(usize, usize)>,
    /// Width of the tokens, and of the hidden layers of feed-forward networks, in the file and in the network.
    widths: Option<[[usize; 2]; 2]>,
    /// Number of blocks of the encoder and of the renderer in the file, where the network has more.
    pub num_blocks: Option<[usize; 2]>,
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
            let widths = |config: &ModelConfig| [config.dim, config.feed_forward_dim];
            let (width, former) = (widths(&model), widths(&found));
            // Heads keep their width.
            let is_wider = width != former && width[0] >= former[0] && width[1] >= former[1];
            if is_wider && width[0] * found.num_heads == former[0] * model.num_heads {
                adapter.widths = Some([former, width]);
                [model.dim, model.feed_forward_dim, model.num_heads] = [former[0], former[1], found.num_heads];
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
        let wider =
            |[former, _]: [[usize; 2]; 2]| format!("a width above {} ({} in feed-forward)", former[0], former[1]);
        let changes = [self.patches.map(longer), self.widths.map(wider), self.num_blocks.map(deeper)];
        let changes: Vec<String> = changes.into_iter().flatten().collect();
        (!changes.is_empty()).then(|| format!("adapted to {}", changes.join(" and ")))
    }

    /// Sets the output layers of added blocks to zero.
    pub fn close_added_blocks<M: Module>(&self, network: M) -> M {
        let Some(num_blocks) = self.num_blocks else { return network };
        network.map(&mut CloseBlocks { num_blocks, path: Vec::new() })
    }

    /// Returns a layer with longer patches.
    fn with_longer_patches(&self, name: &str, layer: Layer) -> Layer {
        let Some((patch_size, factor)) = self.patches else { return layer };
        let (axis, scale) = match name {
            "encoder.patch_embed.weight" | "renderer.ray_embed.weight" => (0, 1.0 / (factor * factor) as f32),
            "renderer.to_pixels.weight" | "renderer.to_pixels.bias" => (1, 1.0),
            _ => return layer,
        };
        // Every pixel of the longer patch takes the channels of the pixel of the former patch that it lies in.
        let channels = layer.shape[axis] / (patch_size * patch_size);
        let side = 0..factor * patch_size;
        let pixels = side.clone().flat_map(|y| side.clone().map(move |x| (y / factor) * patch_size + x / factor));
        let sources: Vec<usize> = pixels.flat_map(|pixel| pixel * channels..(pixel + 1) * channels).collect();
        let mut shape = layer.shape;
        shape[axis] = sources.len();
        match axis {
            0 => Layer::new(shape, |row, column| layer.at(sources[row], column) * scale),
            _ => Layer::new(shape, |row, column| layer.at(row, sources[column])),
        }
    }

    /// Returns a layer with more channels, heads and hidden values.
    fn with_more_channels(&self, name: &str, layer: Layer) -> Layer {
        let Some([[dim, hidden], [new_dim, new_hidden]]) = self.widths else { return layer };
        let has = |part: &str| name.contains(part);
        // Queries, keys and values lie side by side.
        let num_thirds = if has("in_proj") { 3 } else { 1 + usize::from(has("kv_proj")) };
        let is_row = layer.shape[0] == 1;
        let [added, added_hidden] = [new_dim - dim, new_hidden - hidden];
        let added_rows = match () {
            () if is_row || has("_embed") => 0,
            () if has(".down.") => added_hidden,
            () => added,
        };
        let added_columns = match () {
            () if has("to_pixels") => 0,
            () if has(".up.") => added_hidden,
            () => added,
        };
        let former_third = layer.shape[1] / num_thirds;
        let third = former_third + added_columns;
        let [rows, columns] = [layer.shape[0] + added_rows, num_thirds * third];
        let reads = ["in_proj", "q_proj", "kv_proj", ".up.", "to_pixels"].into_iter().any(has);
        let squares: f32 = layer.values.iter().map(|value| value * value).sum();
        let deviation = if reads && !is_row { (squares / layer.values.len() as f32).sqrt() } else { 0.0 };
        let scale = if has("norm") && !has("bias") { (dim as f32 / new_dim as f32).sqrt() } else { 1.0 };
        Layer::new([rows, columns], |row, column| {
            let place = column % third;
            if row < layer.shape[0] && place < former_third {
                layer.at(row, column / third * former_third + place) * scale
            } else if scale < 1.0 {
                scale
            } else {
                // Uniform, with the deviation of the former weights.
                let random = (mix((row * columns + column) as u64) >> 40) as f32 / (1 << 24) as f32;
                deviation * (random - 0.5) * 12_f32.sqrt()
            }
        })
    }

    fn adapted(&self, tensor: &PackTensor) -> Option<PackTensor> {
        // Linear weights are `[inputs, outputs]`.
        let shape = match tensor.shape[..] {
            [rows, columns] => [rows, columns],
            [columns] => [1, columns],
            _ => return None,
        };
        if tensor.dtype != DType::F32 || self.patches.is_none() && self.widths.is_none() {
            return None;
        }
        let bytes = tensor.to_bytes().ok()?;
        let value = |bytes: &[u8]| f32::from_le_bytes(bytes.try_into().expect("four bytes"));
        let layer = Layer { shape, values: bytes.chunks_exact(4).map(value).collect() };
        let layer = self.with_more_channels(&tensor.name, self.with_longer_patches(&tensor.name, layer));
        let shape = Shape::from(layer.shape[2 - tensor.shape[..].len()..].to_vec());
        let values = Bytes::from_elems(layer.values);
        Some(PackTensor::new(tensor.name.clone(), DType::F32, shape, tensor.param_id, values))
    }
}

/// The weights of a layer, `[inputs, outputs]`, or a row of values.
struct Layer {
    shape: [usize; 2],
    values: Vec<f32>,
}

impl Layer {
    fn new([rows, columns]: [usize; 2], value: impl Fn(usize, usize) -> f32) -> Self {
        let values = (0..rows * columns).map(|i| value(i / columns, i % columns)).collect();
        Self { shape: [rows, columns], values }
    }

    fn at(&self, row: usize, column: usize) -> f32 {
        self.values[row * self.shape[1] + column]
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
        self.adapted(&tensor).unwrap_or(tensor)
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
        ModelConfig {
            camera_encoding: CameraEncoding::Gta,
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
        let wide = ModelConfig { dim: 24, num_heads: 3, feed_forward_dim: 40, ..config(2) };
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

        let (network, adapter) = load(&wide).unwrap();
        assert_eq!(adapter.describe().as_deref(), Some("adapted to a width above 16 (24 in feed-forward)"));
        let [expected, found] = [&former, &network].map(|network| render(network, 1));
        let share = (found - expected.clone()).powi_scalar(2).mean()
            / (expected.clone() - expected.mean().unsqueeze()).powi_scalar(2).mean();
        assert!(to_vec(share.clone())[0] < 0.01, "share of the variance: {share}");

        let refused = |config: &ModelConfig| load(config).map(|_| ()).unwrap_err().to_string();
        let wrong = refused(&config(3));
        assert!(wrong.starts_with("`model.patch_size` = 3: the weights are of a network with 2"), "{wrong}");
        let wrong = refused(&ModelConfig { num_encoder_blocks: 0, ..deeper(2) });
        assert!(wrong.starts_with("`model.num_encoder_blocks` = 0: the weights are of a network with 1"), "{wrong}");
        let wider = refused(&ModelConfig { dim: 32, ..config(4) });
        assert!(wider.starts_with("`model.dim` = 32"), "{wider}");
        let narrower = refused(&ModelConfig { dim: 32, num_heads: 4, feed_forward_dim: 20, ..config(2) });
        assert!(narrower.starts_with("`model.num_heads` = 4"), "{narrower}");
        // Weights with longer patches than their config says.
        save_weights(&Network::new(&config(4), 3, &Device::flex()), &path).unwrap();
        let other = refused(&config(8));
        assert!(other.contains(" is [") && other.contains(", expected ["), "{other}");
    }
}
