//! A training step on a GPU (Mesa's software Vulkan counts) gives what the CPU gives.

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::{Device, Gradients, Int, Tensor};
use clift_model::device::DeviceName;
use clift_model::{Cameras, Clift, Clusters, ModelConfig, SceneClusters, Views};

/// Moves every parameter by a fixed pattern: the condenser's gates start at zero, and behind a closed
/// gate every gradient is zero.
struct Perturb;

impl ModuleMapper for Perturb {
    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        param.map(|weight| {
            let shape = weight.dims();
            let index = Tensor::<1, Int>::arange(0..shape.iter().product::<usize>() as i64, &weight.device());
            let pattern = index.float().mul_scalar(0.7).cos().mul_scalar(0.05).reshape(shape);
            // A leaf again, as parameters are.
            (weight + pattern).detach().require_grad()
        })
    }
}

/// Loss and the gradient of every parameter of a small model with condenser.
fn loss_and_gradients(device: &Device) -> (f64, Vec<Vec<f64>>) {
    let device = device.clone().autodiff();
    let config = ModelConfig {
        dim: 32,
        num_heads: 4,
        feed_forward_dim: 48,
        num_encoder_blocks: 1,
        num_renderer_blocks: 1,
        ..ModelConfig::default()
    };
    let model = Clift::new(&config, 0, &device).map(&mut Perturb);
    let cameras = |origin: f32| {
        let pose = |x: f32| [1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
        let c2w: Vec<f32> = [origin, -origin, 0.5 * origin, 1.0].into_iter().flat_map(pose).collect();
        Cameras::upload(&c2w, &[16.0, 16.0, 8.0, 8.0].repeat(4), [2, 2, 16, 16], &device).expect("valid cameras")
    };
    let images: Vec<u8> = (0..2 * 2 * 16 * 16 * 3).map(|i| (i * 37 % 251) as u8).collect();
    let images = clift_model::views::upload_images(&images, [2, 2, 16, 16], &device).expect("the right length");
    let lift = model.encoder.forward(&Views { images: images.clone(), cameras: cameras(0.3) });
    let scene = SceneClusters::new(vec![0, 0, 1, 2, 2, 2, 0, 2], vec![1, 2, 4]).expect("valid clusters");
    let clusters = Clusters::new(vec![scene.clone(), scene]).expect("equal counts").upload(&device);
    let rendering = model.renderer.forward(model.condenser.forward(lift, &clusters), &cameras(0.1));
    let loss = (rendering - images).square().mean();
    let grads = loss.backward();
    (loss.into_scalar::<f64>(), gradients(&model, &grads))
}

fn gradients(model: &Clift, grads: &Gradients) -> Vec<Vec<f64>> {
    struct Collect<'a>(&'a Gradients, Vec<Vec<f64>>);
    impl ModuleVisitor for Collect<'_> {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            let grad = param.val().grad(self.0).expect("every parameter takes part");
            self.1.push(grad.into_data().convert::<f64>().try_to_vec::<f64>().expect("f64"));
        }
    }
    let mut collect = Collect(grads, Vec::new());
    model.visit(&mut collect);
    collect.1
}

#[test]
fn forward_and_backward_equal_the_cpus() {
    let wgpu = match DeviceName::Wgpu.open() {
        Ok(device) => device,
        Err(error) if std::env::var_os("CLIFT_REQUIRE_WGPU").is_some() => panic!("{error}"),
        Err(error) => return eprintln!("not run: {error}"),
    };
    let (loss, grads) = loss_and_gradients(&wgpu);
    let (expected_loss, expected) = loss_and_gradients(&DeviceName::Flex.open().expect("the CPU device"));
    assert!((loss - expected_loss).abs() < 1e-5 * expected_loss, "{loss} against {expected_loss}");
    for (parameter, (grad, expected)) in grads.iter().zip(&expected).enumerate() {
        let scale = expected.iter().fold(0.0_f64, |scale, value| scale.max(value.abs()));
        assert!(scale > 0.0, "parameter {parameter} is not reached");
        let error = grad.iter().zip(expected).fold(0.0_f64, |error, (a, b)| error.max((a - b).abs()));
        // Sums of a few hundred f32 terms in another order, through four blocks; the floor is for keys'
        // biases, whose gradient is zero but for rounding.
        assert!(error <= 1e-3 * scale + 1e-9, "parameter {parameter}: error {error:.2e} of {scale:.2e}");
    }
}
