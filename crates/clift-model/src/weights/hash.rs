//! SHA-256 of the weights of a module.

use burn::module::{Module, ModuleVisitor, Param};
use burn::tensor::{Tensor, TensorData};
use sha2::{Digest, Sha256};

use crate::network::architecture::CameraEncoding;
use crate::network::config::ModelConfig;
use crate::network::renderer::Renderer;

/// Hashes paths, shapes and values of all parameters of a module; returns 64 hexadecimal digits. Equal weights have equal
/// hashes on every device.
pub fn weights_hash<M: Module>(module: &M) -> String {
    let mut sha = Sha256::new();
    visit(module, |name, shape, data| {
        sha.update(name.as_bytes());
        sha.update(format!("{shape:?}"));
        for value in data.iter::<f32>() {
            sha.update(value.to_le_bytes());
        }
    });
    hex::encode(sha.finalize())
}

/// Hashes a renderer's weights ([`weights_hash`]) together with variant, number of heads and camera encoding, which tensor
/// shapes do not determine. They do determine the frame of the rays.
pub fn renderer_hash(renderer: &Renderer, config: &ModelConfig) -> String {
    let ModelConfig { variant, num_heads, camera_encoding, .. } = config;
    // The paper's encoding is not named: the hashes are part of scene files.
    let encoding = match camera_encoding {
        CameraEncoding::Plucker => "",
        CameraEncoding::Gta => "gta ",
    };
    hex::encode(Sha256::digest(format!("{variant} {num_heads} {encoding}{}", weights_hash(renderer))))
}

/// Calls `f` with path, shape and values of every parameter, in the module's order.
pub(crate) fn visit<M: Module>(module: &M, f: impl FnMut(&str, &[usize], &TensorData)) {
    struct Visitor<F> {
        path: Vec<String>,
        f: F,
    }
    impl<F: FnMut(&str, &[usize], &TensorData)> ModuleVisitor for Visitor<F> {
        fn enter_module(&mut self, name: &str, _container: &str) {
            self.path.push(name.into());
        }

        fn exit_module(&mut self, _name: &str, _container: &str) {
            self.path.pop();
        }

        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            (self.f)(&self.path.join("."), &param.val().dims(), &param.val().into_data());
        }
    }
    module.visit(&mut Visitor { path: Vec::new(), f });
}
