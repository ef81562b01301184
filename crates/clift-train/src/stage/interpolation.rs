//! Interpolation between the weights before and after a training (WiSE-FT, Wortsman et al., CVPR 2022): on images unlike
//! those of the training, weights in between are often better than both.

use std::collections::VecDeque;

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::Tensor;

/// Returns `start + position * (trained - start)` for every parameter of two modules with the same parameters. Equal
/// values stay equal bit for bit, -0 too.
pub(crate) fn interpolate<M: Module>(start: &M, trained: M, position: f64) -> M {
    let mut values = Values::default();
    start.visit(&mut values);
    trained.map(&mut Interpolation { start: values, position })
}

/// Parameters in the module's order, flattened.
#[derive(Default)]
struct Values(VecDeque<Tensor<1>>);

impl ModuleVisitor for Values {
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        self.0.push_back(param.val().flatten(0, D - 1));
    }
}

struct Interpolation {
    start: Values,
    position: f64,
}

impl ModuleMapper for Interpolation {
    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let start = self.start.0.pop_front().expect("modules with the same parameters");
        param.map(|trained| {
            let start = start.reshape(trained.dims());
            trained.clone() - (trained - start).mul_scalar(1.0 - self.position)
        })
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;
    use clift_model::{Network, weights_hash};

    use super::*;
    use crate::config::config::Config;
    use crate::config::parse::read_config;
    use crate::testing::fixture;

    fn model(seed: u64) -> Network {
        let (config, _) = read_config::<Config>(&fixture("../tests/micro.toml"), &[]).expect("valid");
        Network::new(&config.model, seed, &Device::flex())
    }

    fn values(model: &Network) -> Vec<f32> {
        let mut values = Values::default();
        model.visit(&mut values);
        values.0.into_iter().flat_map(|tensor| tensor.try_into_vec_as::<f32>().expect("on the CPU")).collect()
    }

    #[test]
    fn equal_weights_stay_equal_bit_for_bit() {
        struct Negative;
        impl ModuleMapper for Negative {
            fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
                param.map(Tensor::neg)
            }
        }
        // The gates of the condenser are -0.
        let start = model(1).map(&mut Negative);
        assert!(values(&start).iter().any(|value| value.to_bits() == (-0.0f32).to_bits()));
        assert_eq!(weights_hash(&interpolate(&start, start.clone(), 0.3)), weights_hash(&start));
    }
}
