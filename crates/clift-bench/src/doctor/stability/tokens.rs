//! Tokens stored in 16 and 8 bits.

use burn::module::Module;
use burn::tensor::{Tensor, TensorData};
use clift_model::{Cameras, ModelError, Views};
use clift_scene::TokenFormat;
use clift_train::{TrainError, seeded_clip, seeded_model};

use crate::cases::reference::{ToF64, largest_magnitude, module_in_f64, values};
use crate::doctor::stability::case::{Bound, CaseDevices, Outcome, StabilityCase};
use crate::doctor::stability::updates::{network, shape};

pub(crate) const CASES: &[StabilityCase] = &[
    StabilityCase {
        name: "tokens in f32",
        breaks: "the way to a file and back",
        bound: Bound::Most(1e-5),
        reason: "nothing is rounded; of images, whose values are below 1",
        run: |devices| render_error(devices, TokenFormat::F32),
    },
    StabilityCase {
        name: "tokens in f16",
        breaks: "colours of a renderer that was not trained with them",
        bound: Bound::Most(2e-3),
        reason: "values are rounded by 5e-4, and half a grey level is 2e-3",
        run: |devices| render_error(devices, TokenFormat::F16),
    },
    StabilityCase {
        name: "tokens in int8",
        breaks: "the same",
        bound: Bound::Most(2e-2),
        reason: "values are rounded by 1/254 of a token's largest",
        run: |devices| render_error(devices, TokenFormat::Int8),
    },
    StabilityCase {
        name: "tokens beyond 65,504 in f16",
        breaks: "infinities in a file",
        bound: Bound::Refused("largest 16-bit float is 65504"),
        reason: "f16 ends there",
        run: |_| match TokenFormat::F16.round(&[1.0, 7e4], 2) {
            Err(error @ ModelError::BadConfig { .. }) => Ok(Outcome::Refused(error.to_string())),
            Err(other) => Err(other.into()),
            Ok(_) => Ok(Outcome::Error(0.0)),
        },
    },
    StabilityCase {
        name: "tokens of 1e-30 and 1e30 in int8",
        breaks: "the scale's inverse",
        bound: Bound::Most(4e-3),
        reason: "1/254 of each token's largest value",
        run: |_| {
            let tokens = [1e-30, -5e-31, 1e30, 3e29];
            let rounded = TokenFormat::Int8.round(&tokens, 2)?;
            let largest = [1e-30_f64, 1e-30, 1e30, 1e30];
            let errors = rounded.iter().zip(tokens).zip(largest);
            Ok(Outcome::Error(largest_magnitude(
                errors.map(|((a, b), largest)| (f64::from(*a) - f64::from(b)) / largest),
            )))
        },
    },
];

/// Returns the largest difference between an image rendered from rounded tokens and one rendered in f64 from exact ones.
fn render_error(devices: &CaseDevices, storage: TokenFormat) -> Result<Outcome, TrainError> {
    let config = network(devices);
    let networks = seeded_model(&config, 0, &devices.device).valid();
    let clip = seeded_clip(shape(devices, 4), 0, 0);
    let lift = networks.encoder.forward(&Views::upload(&[&clip.context], &devices.device)?);
    let shape = lift.dims();
    let tokens: Vec<f32> = values(lift.values.clone()).into_iter().map(|value| value as f32).collect();
    let rounded = TensorData::new(storage.round(&tokens, config.dim)?, shape);
    let rounded: Tensor<3> = Tensor::from_data(rounded, &devices.device);
    let cameras = Cameras::upload(&[&clip.target], &devices.device)?;
    let rendering = networks.renderer.forward(lift.with_values(rounded), &cameras);
    let renderer = module_in_f64(&networks.renderer, &devices.reference);
    let expected = renderer.forward(lift.in_f64(&devices.reference), &cameras.in_f64(&devices.reference));
    let pairs = values(rendering).into_iter().zip(values(expected));
    Ok(Outcome::Error(largest_magnitude(pairs.map(|(a, b)| a - b))))
}
