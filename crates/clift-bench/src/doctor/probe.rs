//! One forward and backward pass of a small model on a device.

use std::panic::{AssertUnwindSafe, PanicHookInfo, catch_unwind};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use burn::module::Module;
use burn::tensor::{DType, Device};
use clift_model::{DeviceName, KMeans, ModelConfig, Precision, Views};
use clift_train::{ClipShape, TrainError, seeded_batch, seeded_model};

use crate::cases::reference::largest_magnitude;
use crate::cases::step::loss_and_gradient;

/// Capabilities of a working device.
#[derive(Clone, Debug)]
pub struct DeviceCheck {
    /// Name of the adapter.
    pub adapter: String,
    /// Supported floating-point types.
    pub dtypes: Vec<&'static str>,
    /// Loss and gradient of the small model.
    pub gradient: Gradient,
    /// Seconds of the second pass; the first one compiles kernels.
    pub seconds: f64,
}

/// Loss of the small model and gradient of all weights.
#[derive(Clone, Debug)]
pub struct Gradient {
    /// The loss.
    pub loss: f64,
    /// One value per weight.
    pub values: Vec<f64>,
}

impl Gradient {
    /// Returns the larger of two relative differences: of the loss, and of the gradient over its largest entry. NaN if the
    /// number of weights differs.
    pub fn difference(&self, reference: &Self) -> f64 {
        if self.values.len() != reference.values.len() {
            return f64::NAN;
        }
        let pairs = self.values.iter().zip(&reference.values);
        let worst = largest_magnitude(pairs.map(|(a, b)| a - b));
        let scale = largest_magnitude(reference.values.iter().copied()).max(f64::MIN_POSITIVE);
        let loss = (self.loss - reference.loss).abs() / reference.loss.abs().max(f64::MIN_POSITIVE);
        largest_magnitude([worst / scale, loss].into_iter())
    }
}

/// Opens a device and computes one forward and backward pass of a small model.
///
/// # Errors
/// The message of the error or of the panic.
pub fn probe(name: DeviceName, precision: Precision) -> Result<DeviceCheck, String> {
    catch_panic(|| probe_device(name, precision)).unwrap_or_else(|panic| Err(format!("panicked: {panic}")))
}

fn probe_device(name: DeviceName, precision: Precision) -> Result<DeviceCheck, String> {
    let device = name.open().map_err(|error| error.to_string())?;
    precision.check("precision", &device).map_err(|error| error.to_string())?;
    let _scope = precision.scope();
    let floats = [("f32", DType::F32), ("f16", DType::F16), ("bf16", DType::BF16), ("f64", DType::F64)];
    let dtypes = floats.into_iter().filter(|(_, dtype)| device.supports_dtype(*dtype)).map(|(name, _)| name).collect();
    gradient(&device).map_err(|error| error.to_string())?;
    let started = Instant::now();
    let gradient = gradient(&device).map_err(|error| error.to_string())?;
    let seconds = started.elapsed().as_secs_f64();
    Ok(DeviceCheck { adapter: adapter(name, &device), dtypes, gradient, seconds })
}

#[cfg(feature = "wgpu")]
fn adapter(name: DeviceName, device: &Device) -> String {
    match name {
        DeviceName::Wgpu => device.identity().map_or_else(|| "unnamed".into(), |identity| identity.name),
        DeviceName::Flex | DeviceName::Ndarray => "CPU".into(),
    }
}

#[cfg(not(feature = "wgpu"))]
fn adapter(_name: DeviceName, _device: &Device) -> String {
    "CPU".into()
}

/// Encodes, clusters, condenses and renders one clip, and computes the gradient of all three networks.
fn gradient(device: &Device) -> Result<Gradient, TrainError> {
    let config = ModelConfig {
        dim: 32,
        num_heads: 2,
        feed_forward_dim: 64,
        num_encoder_blocks: 1,
        num_renderer_blocks: 1,
        ..ModelConfig::default()
    };
    let shape = ClipShape { num_context: 2, num_targets: 1, size: [16, 16] };
    let num_tokens = config.num_tokens(2, 16, 16)?;
    let model = seeded_model(&config, 0, device);
    let batch = seeded_batch(shape, 1, num_tokens, Some(num_tokens / 4), 0)?;
    // The clusters of the batch are random: those of K-means may depend on the last bit of a distance.
    let views = Views::upload(&[&batch.clips[0].context], device)?;
    KMeans::default().fit(model.valid().encode(&views).values, num_tokens / 4, &[0])?;
    let (loss, values) = loss_and_gradient(&model, &batch, device)?;
    Ok(Gradient { loss, values })
}

type Hook = Box<dyn Fn(&PanicHookInfo<'_>) + Sync + Send>;

/// Runs `work` without printing panics.
///
/// # Errors
/// The first line of the first panic, in `work` or in a thread of it.
pub fn catch_panic<T>(work: impl FnOnce() -> T) -> Result<T, String> {
    // A process has one panic hook.
    static HOOK: Mutex<()> = Mutex::new(());
    let _guard = HOOK.lock().unwrap_or_else(PoisonError::into_inner);
    let message = Arc::new(Mutex::new(None));
    let first = Arc::clone(&message);
    let former: Hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        let text = info.payload_as_str().unwrap_or("no message").lines().next().unwrap_or_default().to_owned();
        first.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(text);
    }));
    let result = catch_unwind(AssertUnwindSafe(work));
    std::panic::set_hook(former);
    let message = message.lock().unwrap_or_else(PoisonError::into_inner).take();
    result.map_err(|_| message.unwrap_or_else(|| "no message".into()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn panic_is_returned_as_its_first_line() {
        assert_eq!(catch_panic(|| -> u8 { panic!("no adapter\nin sight") }), Err("no adapter".into()));
        assert_eq!(catch_panic(|| 3), Ok(3));
    }

    #[test]
    fn difference_is_relative_and_includes_the_loss() {
        let gradient = |loss, values: &[f64]| Gradient { loss, values: values.to_vec() };
        let reference = gradient(2.0, &[4.0, 0.0]);
        assert_eq!(gradient(2.0, &[4.0, 1.0]).difference(&reference), 0.25);
        assert_eq!(gradient(3.0, &[4.0, 0.0]).difference(&reference), 0.5);
        assert!(gradient(2.0, &[4.0]).difference(&reference).is_nan());
    }
}
