//! Encoder, token norm, condenser and renderer together.

use burn::module::Module;
use burn::store::PathFilter;
use burn::tensor::{Device, Tensor};

use crate::network::blocks::norms::LiftNorm;
use crate::network::condenser::Condenser;
use crate::network::config::ModelConfig;
use crate::network::encoder::Encoder;
use crate::network::init::Init;
use crate::network::render_tokens::RenderTokens;
use crate::network::renderer::Renderer;
use crate::network::tokens::Tokens;
use crate::tokens::clusters::ClusterIndex;
use crate::views::upload::{Cameras, Views};

/// Encoder, token norm, condenser and renderer. Stage 1 trains encoder and renderer, stage 2 condenser and renderer.
#[derive(Module, Debug)]
pub struct Network {
    /// Context views to light-field tokens.
    pub encoder: Encoder,
    /// Norm of the encoder's tokens, of variants that have one. Both stages train it.
    pub lift_norm: Option<LiftNorm>,
    /// Light-field tokens to storage tokens.
    pub condenser: Condenser,
    /// Tokens and a camera to an image.
    pub renderer: Renderer,
}

impl Network {
    /// Makes a model with random weights, which depend on the seed and not on the device.
    pub fn new(config: &ModelConfig, seed: u64, device: &Device) -> Self {
        let mut init = Init::of(config, seed, device);
        let encoder = Encoder::new(config, &mut init);
        let renderer = Renderer::new(config, &mut init);
        // The condenser comes after encoder and renderer, whose weights so do not depend on its settings.
        let condenser = Condenser::new(config, &mut init);
        let lift_norm = config.has_token_norm().then(|| LiftNorm::new(config, &mut init));
        Self { encoder, lift_norm, condenser, renderer }
    }

    /// Matches the parameters that stage 1 trains and saves: all but the condenser's.
    pub fn stage1_part() -> PathFilter {
        PathFilter::from_predicate(|path, _| !is_condenser(path))
    }

    /// Matches the condenser's parameters.
    pub fn condenser_part() -> PathFilter {
        PathFilter::from_predicate(|path, _| is_condenser(path))
    }

    /// Returns the encoder's output. Stage 2 freezes the encoder, so that both stages of a run have equal features.
    pub fn features(&self, context: &Views) -> Tokens {
        self.encoder.forward(context)
    }

    /// Returns the tokens that this model compresses and renders.
    pub fn normalize(&self, features: Tokens) -> Tokens {
        match &self.lift_norm {
            Some(norm) => Tokens { values: norm.forward(features.values), ..features },
            None => features,
        }
    }

    /// Returns the tokens of context views: [`normalize`](Self::normalize) of the [`features`](Self::features).
    pub fn encode(&self, context: &Views) -> Tokens {
        self.normalize(self.features(context))
    }

    /// Writes the tokens of every cluster into one token (paper section 3.2).
    pub fn compress(&self, tokens: Tokens, clusters: &ClusterIndex) -> Tokens {
        self.condenser.forward(tokens, clusters)
    }

    /// Renders target views, each the mean of its patch grids.
    ///
    /// # Shapes
    /// - returns RGB in `(0, 1)`, `[batch, views, height, width, 3]`
    ///
    /// # Panics
    /// If the network has camera-relative attention and the tokens were made [without cameras](Tokens::without_cameras).
    pub fn render(&self, tokens: impl Into<RenderTokens>, targets: &Cameras) -> Tensor<5> {
        self.renderer.render(tokens, targets)
    }
}

pub(crate) fn is_condenser(path: &str) -> bool {
    path.starts_with("condenser.")
}

#[cfg(test)]
mod tests {
    use burn::tensor::DType;
    use clift_core::{Camera, DMat3, Intrinsics, Pose};

    use super::*;
    use crate::network::architecture::CameraEncoding;
    use crate::ops::precision::Precision;
    use crate::testing::{
        Fixture, assert_close, devices, error_norms, gradient_pairs, load_weights, random, small_lvsm, weight_gradients,
    };
    use crate::views::rays::RayFrame;

    fn small(config: ModelConfig) -> ModelConfig {
        ModelConfig {
            dim: 16,
            num_heads: 4,
            feed_forward_dim: 24,
            num_encoder_blocks: 2,
            num_renderer_blocks: 2,
            ..config
        }
    }

    #[test]
    fn encoder_and_renderer_equal_pytorch_with_gradients() {
        assert_equals_pytorch("model", &small(ModelConfig::default()));
        assert_equals_pytorch("lvsm", &small(small_lvsm()));
    }

    /// Two scenes of two context views and a target view, on the flex device, in another frame with `turned`.
    fn two_scenes(turned: bool) -> (Views, Cameras) {
        let device = Device::flex();
        let frame = Pose { rotation: DMat3::from_rotation_x(0.7), translation: [0.5, -2.0, 1.0].into() };
        let camera = |index: usize| {
            let shift = [0.3 * index as f64, 0.1, -0.2 * (index % 3) as f64];
            let c2w = Pose { rotation: DMat3::from_rotation_y(0.2 * index as f64), translation: shift.into() };
            let intrinsics = Intrinsics { fx: 20.0, fy: 21.0, cx: 8.5, cy: 7.5 };
            Camera { c2w: if turned { frame.after(c2w) } else { c2w }, intrinsics }
        };
        let upload = |views: [usize; 2]| {
            let cameras = Cameras::of_views(&views.map(camera), 16, 16, &device).expect("valid");
            let (c2w, intrinsics) = (cameras.c2w.reshape([2, 1, 4, 4]), cameras.intrinsics.reshape([2, 1, 4]));
            Cameras { c2w, intrinsics, ..cameras }
        };
        let [first, second] = [[0, 3], [1, 4]].map(upload);
        let c2w = Tensor::cat(vec![first.c2w, second.c2w], 1);
        let cameras = Cameras { intrinsics: Tensor::cat(vec![first.intrinsics, second.intrinsics], 1), c2w, ..first };
        let images = random([2, 2, 16 * 16 * 3], 5, &device).reshape([2, 2, 16, 16, 3]).cast(DType::F32);
        (Views { images, cameras }, upload([2, 5]))
    }

    #[test]
    fn camera_relative_networks_depend_on_relative_poses_alone() {
        let sizes = small(ModelConfig { camera_encoding: CameraEncoding::Gta, ..ModelConfig::default() });
        let config = ModelConfig { rays: RayFrame::Camera, num_heads: 2, ..sizes };
        let model = Network::new(&config, 3, &Device::flex());
        let [(context, targets), turned] = [false, true].map(two_scenes);
        let tokens = model.encode(&context);
        let expected = model.render(tokens.clone(), &targets);
        // In f32, poses of the turned frame are rounded to 1e-7.
        assert_close(&model.render(model.encode(&turned.0), &turned.1), &expected, 2e-5);
        // Tokens in another order keep their cameras.
        assert_close(&model.render(tokens.select(&[7, 1, 2, 6, 4, 5, 3, 0]), &targets), &expected, 2e-5);
    }

    struct ForwardPass {
        encoder: Encoder,
        renderer: Renderer,
        lift: Tensor<3>,
        rendering: Tensor<5>,
        loss: Tensor<1>,
    }

    fn forward(fixture: &Fixture, config: &ModelConfig, device: &Device) -> ForwardPass {
        let Network { encoder, renderer, .. } = Network::new(config, 0, device);
        let encoder = load_weights(encoder, fixture, "weight.encoder.");
        let renderer = load_weights(renderer, fixture, "weight.renderer.");
        let cameras = |prefix: &str| fixture.cameras(prefix, device, DType::F32);
        let context = Views { images: fixture.tensor("input.context_images", device), cameras: cameras("context_") };
        let tokens = encoder.forward(&context);
        let lift = tokens.values.clone();
        let rendering = renderer.forward(tokens, &cameras("target_"));
        let loss = (rendering.clone() - fixture.tensor("input.target_images", device)).square().mean();
        ForwardPass { encoder, renderer, lift, rendering, loss }
    }

    fn assert_equals_pytorch(name: &str, config: &ModelConfig) {
        let fixture = Fixture::open(name);
        for device in devices() {
            let device = device.autodiff();
            let ForwardPass { encoder, renderer, lift, rendering, loss } = forward(&fixture, config, &device);
            assert_close(&lift.inner(), &fixture.tensor::<3>("output.lift", &device).inner(), 1e-5);
            assert_close(&rendering.inner(), &fixture.tensor::<5>("output.rendering", &device).inner(), 1e-5);
            let expected = fixture.tensor::<1>("output.loss", &device);
            assert_close(&loss.clone().inner(), &expected.inner(), 1e-6);
            let grads = loss.backward();
            weight_gradients(&encoder, &grads, &fixture, "grad.weight.encoder.", 5e-5);
            weight_gradients(&renderer, &grads, &fixture, "grad.weight.renderer.", 5e-5);
        }
    }

    /// Errors against f64, norm over norm; those of PyTorch are from `scripts/fixtures/make_autocast_errors.py`. Processors
    /// without bf16 emulate it.
    #[test]
    fn bf16_is_at_least_as_close_to_f64_as_pytorch_autocast() {
        let device = Device::flex().autodiff();
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../data-fixtures/reference/autocast.json");
        let text = std::fs::read_to_string(path).expect("a checked-in file");
        let pytorch: serde_json::Value = serde_json::from_str(&text).expect("JSON");
        let pytorch = |name: &str| pytorch["errors"][name].as_f64().unwrap_or_else(|| panic!("{name} is in {path}"));
        let fixture = Fixture::open("model");
        let _scope = Precision::Bf16.scope();
        let ForwardPass { encoder, renderer, lift, rendering, loss } =
            forward(&fixture, &small(ModelConfig::default()), &device);
        let check = |name: &str, pairs: &[[Tensor<1>; 2]]| {
            let [difference, norm] = error_norms(pairs);
            let error = difference / norm;
            assert!(error <= pytorch(name), "{name}: {error:.2e}, PyTorch {:.2e}", pytorch(name));
        };
        let expected = fixture.tensor::<3>("output.lift", &device);
        check("output.lift", &[[lift, expected].map(|x| x.inner().reshape([-1]))]);
        let expected = fixture.tensor::<5>("output.rendering", &device);
        check("output.rendering", &[[rendering, expected].map(|x| x.inner().reshape([-1]))]);
        let grads = loss.backward();
        let mut pairs = gradient_pairs(&encoder, &grads, &fixture, "grad.weight.encoder.");
        let mut ratios = Vec::new();
        let mut of_renderer = gradient_pairs(&renderer, &grads, &fixture, "grad.weight.renderer.");
        for (prefix, pairs) in [("encoder", &pairs), ("renderer", &of_renderer)] {
            for (name, pair) in pairs {
                let [difference, norm] = error_norms(std::slice::from_ref(pair));
                ratios.push(difference / norm / pytorch(&format!("grad.weight.{prefix}.{name}")));
            }
        }
        pairs.append(&mut of_renderer);
        check("grad", &pairs.into_iter().map(|(_, pair)| pair).collect::<Vec<_>>());
        // Single gradients differ by chance; half of them are closer than PyTorch's.
        ratios.sort_by(f64::total_cmp);
        assert!(ratios[ratios.len() / 2] <= 1.0, "median {:.2} of PyTorch's error", ratios[ratios.len() / 2]);
    }
}
