//! The device and the inputs of a case; the inputs are the same on every device.
// B scenes, V views, N tokens, D width

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::{Device, Gradients, Tensor, TensorData};
use clift_core::{Camera, ClipViews, DMat3, DVec3, Intrinsics, Pose};
use clift_data::Clip;
use clift_model::{
    Cameras, CliftVariant, Condenser, CondenserConfig, Encoder, Init, ModelConfig, Network, Renderer, SceneClusters,
    Views,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::table::{Named, Values};

/// Rows and columns of an image: two rows of three patches, so that swapped axes are detected.
pub const SIZE: [usize; 2] = [16, 24];
pub const BATCH: usize = 2;
/// Context views, and target views, of a scene.
pub const VIEWS: usize = 2;
pub const NUM_TOKENS: usize = VIEWS * 6;
pub const DIM: usize = 32;

/// A device, and whether the inputs are slightly wrong.
pub struct Place {
    pub device: Device,
    /// Whether inputs not made by [`random`](Self::random) must be slightly wrong.
    pub is_wrong: bool,
}

impl Place {
    pub fn new(device: &Device) -> Self {
        Self { device: device.clone().autodiff(), is_wrong: false }
    }

    /// The same device with one number of every input changed by two hundredths of its range.
    pub fn wrong(&self) -> Self {
        Self { device: self.device.clone(), is_wrong: true }
    }

    /// Uniform values in `[-1, 1)`.
    pub fn random<const D: usize>(&self, shape: [usize; D], seed: u64) -> Tensor<D> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut values: Vec<f32> = (0..shape.iter().product()).map(|_| rng.random_range(-1.0..1.0)).collect();
        if self.is_wrong {
            values[0] += 0.04;
        }
        self.tensor(values, shape)
    }

    pub fn tokens(&self, seed: u64) -> Tensor<3> {
        self.random([BATCH, NUM_TOKENS, DIM], seed)
    }

    pub fn tensor<const D: usize>(&self, values: Vec<f32>, shape: [usize; D]) -> Tensor<D> {
        Tensor::from_data(TensorData::new(values, shape), &self.device)
    }

    pub fn plain(&self) -> Device {
        self.device.clone().without_autodiff()
    }

    /// Moves every parameter by a fixed pattern: behind gates, which start at zero, every gradient would be zero.
    pub fn module<M: Module>(&self, make: impl FnOnce(&mut Init) -> M) -> M {
        make(&mut Init::new(7, &self.device)).map(&mut Move)
    }

    /// Makes a module of a network as [`module`](Self::module), with the norms and biases that its layers have.
    pub fn module_of<M: Module>(&self, network: &ModelConfig, make: impl FnOnce(&mut Init) -> M) -> M {
        make(&mut Init::of(network, 7, &self.device)).map(&mut Move)
    }

    pub fn model(&self) -> Network {
        let config = network(CliftVariant::Paper);
        self.module(|init| Network {
            encoder: Encoder::new(&config, init),
            renderer: Renderer::new(&config, init),
            condenser: Condenser::new(&config, init),
            lift_norm: None,
        })
    }

    /// A scene's clip: waves of colour, with cameras on an arc.
    pub fn clip(&self, scene: usize) -> Clip {
        let views = |places: [f64; VIEWS]| {
            let [height, width] = SIZE;
            let intrinsics = Intrinsics { fx: 20.0, fy: 21.0, cx: 12.5, cy: 7.5 };
            let mut images: Vec<u8> = (0..VIEWS * height * width * 3)
                .map(|i| (127.0 + 110.0 * ((i + 31 * scene) as f64 * (0.13 + places[0] / 10.0)).sin()) as u8)
                .collect();
            if self.is_wrong {
                images[0] ^= 32;
            }
            let c2w = places.map(|place| pose(place + 0.1 * scene as f64 + f64::from(self.is_wrong) * 0.02));
            ClipViews {
                width,
                height,
                images,
                cameras: c2w.map(|c2w| Camera { c2w, intrinsics }).into(),
                frame_index: vec![0, 1],
            }
        };
        Clip {
            key: format!("scene {scene}"),
            context: views([-0.8, 0.7]),
            target: views([-0.3, 0.4]),
            target_weights: None,
        }
    }

    pub fn clips(&self) -> Vec<Clip> {
        (0..BATCH).map(|scene| self.clip(scene)).collect()
    }

    pub fn context(&self) -> Views {
        let clips = self.clips();
        Views::upload(&clips.iter().map(|clip| &clip.context).collect::<Vec<_>>(), &self.device).expect("equal sizes")
    }

    pub fn targets(&self) -> Cameras {
        let clips = self.clips();
        Cameras::upload(&clips.iter().map(|clip| &clip.target).collect::<Vec<_>>(), &self.device).expect("equal sizes")
    }

    /// Runs `f` forward on inputs and backward from a fixed gradient of the result.
    pub fn differentiate<M: Module, const COUNT: usize, const D: usize>(
        &self,
        module: &M,
        inputs: [Tensor<3>; COUNT],
        f: impl FnOnce(&M, [Tensor<3>; COUNT]) -> Tensor<D>,
    ) -> Values {
        let inputs = inputs.map(Tensor::require_grad);
        let output = f(module, inputs.clone()).flatten::<1>(0, D - 1);
        let result = values(output.clone().inner());
        let pull: Vec<f32> = (0..result.len()).map(|i| (i as f32 * 0.37 + 0.2).sin()).collect();
        let grads = (output * self.tensor(pull, [result.len()])).sum().backward();
        let mut backward: Named = inputs
            .iter()
            .enumerate()
            .map(|(i, input)| (format!("input {i}"), values(input.grad(&grads).expect("the input takes part"))))
            .collect();
        backward.extend(gradients(module, &grads));
        Values { forward: vec![("result".into(), result)], backward }
    }
}

/// A pose on an arc, turned towards its middle.
fn pose(place: f64) -> Pose {
    let rotation = DMat3::from_rotation_y(-0.5 * place);
    Pose { rotation, translation: DVec3::new(place, 0.1 * place, 0.25 * place * place) }
}

pub fn network(variant: CliftVariant) -> ModelConfig {
    ModelConfig {
        variant,
        dim: DIM,
        num_heads: 4,
        feed_forward_dim: 48,
        num_encoder_blocks: 1,
        num_renderer_blocks: 1,
        condenser: CondenserConfig::of(variant),
        ..ModelConfig::default()
    }
}

/// Clusters of the two scenes: of six, three, two tokens and one alone; and evenly.
pub fn clusters() -> Vec<SceneClusters> {
    let scene = |assignment: [u32; NUM_TOKENS], centroids: [u32; 4]| {
        SceneClusters::new(assignment.into(), centroids.into()).expect("centroids lie in their clusters")
    };
    vec![
        scene([0, 0, 1, 2, 0, 0, 3, 2, 0, 1, 2, 0], [4, 9, 3, 6]),
        scene([0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3], [0, 5, 10, 3]),
    ]
}

/// Values in f64, row-major.
pub fn values<const D: usize>(tensor: Tensor<D>) -> Vec<f64> {
    tensor.try_into_vec_as::<f64>().expect("the device gives its values back")
}

/// Gradients of those parameters of a module that have one, by their paths.
pub fn gradients<M: Module>(module: &M, grads: &Gradients) -> Named {
    collect(module, Some(grads))
}

/// Values of a module's parameters, by their paths.
pub fn parameters<M: Module>(module: &M) -> Named {
    collect(module, None)
}

fn collect<M: Module>(module: &M, grads: Option<&Gradients>) -> Named {
    struct Collect<'a> {
        grads: Option<&'a Gradients>,
        path: Vec<String>,
        found: Named,
    }
    impl ModuleVisitor for Collect<'_> {
        fn enter_module(&mut self, name: &str, _container: &str) {
            self.path.push(name.into());
        }

        fn exit_module(&mut self, _name: &str, _container: &str) {
            self.path.pop();
        }

        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            let tensor = match self.grads {
                Some(grads) => param.val().grad(grads),
                None => Some(param.val().inner()),
            };
            self.found.extend(tensor.map(|tensor| (self.path.join("."), values(tensor))));
        }
    }
    let mut collect = Collect { grads, path: Vec::new(), found: Named::new() };
    module.visit(&mut collect);
    collect.found
}

/// Adds a fixed pattern to every parameter.
struct Move;

impl ModuleMapper for Move {
    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        param.map(|weight| {
            let shape = weight.dims();
            // Made on the host, where its cosines are the same for every device.
            let pattern: Vec<f32> = (0..shape.iter().product()).map(|i| 0.1 * (i as f32 * 0.7).cos()).collect();
            let pattern = Tensor::from_data(TensorData::new(pattern, shape), &weight.device());
            // A leaf again, as parameters are.
            (weight + pattern).detach().require_grad()
        })
    }
}
