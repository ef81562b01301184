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

/// A working device.
#[derive(Clone, Debug)]
pub struct DeviceCheck {
    /// Name of the adapter.
    pub adapter: String,
    /// Supported floating-point types.
    pub dtypes: Vec<&'static str>,
    /// Loss of a small model.
    pub loss: f64,
    /// Gradient of the loss, one value per weight.
    pub gradient: Vec<f64>,
    /// Seconds of the second pass; the first one compiles kernels.
    pub seconds: f64,
}

impl DeviceCheck {
    /// Returns the larger of two relative differences: of the loss, and of the gradient over its largest entry. NaN if the
    /// number of weights differs.
    pub fn difference(&self, reference: &Self) -> f64 {
        if self.gradient.len() != reference.gradient.len() {
            return f64::NAN;
        }
        let pairs = self.gradient.iter().zip(&reference.gradient);
        let worst = largest_magnitude(pairs.map(|(a, b)| a - b));
        let scale = largest_magnitude(reference.gradient.iter().copied()).max(f64::MIN_POSITIVE);
        let loss = (self.loss - reference.loss).abs() / reference.loss.abs().max(f64::MIN_POSITIVE);
        largest_magnitude([worst / scale, loss].into_iter())
    }
}

/// Opens a device and computes one forward and backward pass of a small model.
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
    let (loss, gradient) = gradient(&device).map_err(|error| error.to_string())?;
    let seconds = started.elapsed().as_secs_f64();
    Ok(DeviceCheck { adapter: adapter(name, &device), dtypes, loss, gradient, seconds })
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
fn gradient(device: &Device) -> Result<(f64, Vec<f64>), TrainError> {
    let config = ModelConfig { dim: 32, feed_forward_dim: 64, ..ModelConfig::small() };
    let shape = ClipShape { num_context: 2, num_targets: 1, size: [16, 16] };
    let num_tokens = config.num_tokens(2, 16, 16)?;
    let model = seeded_model(&config, 0, device);
    let batch = seeded_batch(shape, 1, Some([num_tokens, num_tokens / 4]), 0)?;
    // The clusters of the batch are random: those of K-means may depend on the last bit of a distance.
    let views = Views::upload(&[&batch.clips[0].context], device)?;
    KMeans::default().fit(model.valid().encode(&views).values, num_tokens / 4, &[0])?;
    loss_and_gradient(&model, &batch, device)
}

type Hook = Box<dyn Fn(&PanicHookInfo<'_>) + Sync + Send>;

/// Runs `work` without printing panics.
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
}
