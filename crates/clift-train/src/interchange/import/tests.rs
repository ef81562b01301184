use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use burn::tensor::{Device, Tensor, TensorData};
use clift_data::write_state_dict;
use clift_model::{
    Cameras, CliftVariant, Clusters, DeviceName, ModelPath, PREFIX, SceneClusters, SceneModel, TrainedModel, Views,
};
use safetensors::SafeTensors;
use safetensors::tensor::Dtype;

use super::*;
use crate::config::parse::read_config;
use crate::interchange::export::{ExportFormat, export};

mod keys;

/// Name, variant and heads of every checkpoint that `scripts/fixtures/make_checkpoints.py` wrote.
const CHECKPOINTS: [(&str, CliftVariant, Option<usize>); 5] = [
    ("re10k", CliftVariant::ReleasedRe10k, Some(3)),
    ("re10k_first", CliftVariant::ReleasedRe10k, Some(5)),
    ("dl3dv", CliftVariant::ReleasedDl3dv, None),
    ("dl3dv_one", CliftVariant::ReleasedDl3dv, None),
    ("paper", CliftVariant::Paper, Some(3)),
];

/// Imports without interrupt.
fn import(file: &Path, out: &Path, options: &ImportOptions) -> Result<(Config, ImportRecord), TrainError> {
    crate::interchange::import::import(file, out, options, &AtomicBool::new(false))
}

fn fixture(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../data-fixtures/checkpoints").join(name)
}

fn options(variant: CliftVariant, num_heads: Option<usize>) -> ImportOptions {
    ImportOptions { variant, num_heads, convert: false, renames: Vec::new() }
}

/// Inputs and outputs of the PyTorch twin.
struct Reference(Vec<u8>);

impl Reference {
    fn open(name: &str) -> Self {
        Self(std::fs::read(fixture(&format!("{name}.safetensors"))).unwrap())
    }

    fn values(&self, name: &str) -> Option<(Vec<usize>, Vec<f64>)> {
        let file = SafeTensors::deserialize(&self.0).unwrap();
        let view = file.tensor(name).ok()?;
        let data = view.data();
        let values = match view.dtype() {
            Dtype::F32 => data.as_chunks().0.iter().map(|bytes| f64::from(f32::from_le_bytes(*bytes))).collect(),
            Dtype::F64 => data.as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect(),
            Dtype::I64 => data.as_chunks().0.iter().map(|bytes| i64::from_le_bytes(*bytes) as f64).collect(),
            other => panic!("{name} is {other:?}"),
        };
        Some((view.shape().to_vec(), values))
    }

    fn tensor<const D: usize>(&self, name: &str, device: &Device) -> Tensor<D> {
        let (shape, values) = self.values(name).unwrap();
        let values: Vec<f32> = values.into_iter().map(|value| value as f32).collect();
        Tensor::from_data(TensorData::new(values, shape), device)
    }

    fn counts(&self, name: &str) -> Vec<u32> {
        self.values(name).unwrap().1.into_iter().map(|value| value as u32).collect()
    }

    fn cameras(&self, kind: &str, device: &Device) -> Cameras {
        Cameras {
            height: 16,
            width: 24,
            c2w: self.tensor(&format!("input.{kind}_c2w"), device),
            intrinsics: self.tensor(&format!("input.{kind}_intrinsics"), device),
        }
    }

    #[track_caller]
    fn assert_close<const D: usize>(&self, name: &str, got: &Tensor<D>) {
        let (shape, expected) = self.values(name).unwrap();
        assert_eq!(got.dims().to_vec(), shape, "{name}");
        let got: Vec<f32> = got.to_data().try_to_vec().unwrap();
        let error = got.iter().zip(&expected).map(|(got, expected)| (f64::from(*got) - expected).abs());
        let error = error.fold(0.0, f64::max);
        // Values up to about 5 through at most four blocks in f32.
        assert!(error <= 1e-4, "{name} differs by {error:.2e}");
    }
}

/// Compares features, condensed tokens and images of an imported model with those of the twin, on every CPU device.
fn assert_computes(folder: &Path, name: &str) {
    let reference = Reference::open(name);
    let (mut config, _) = read_config::<Config>(&folder.join("config.toml"), &[]).unwrap();
    let sizes = [
        config.model.dim,
        config.model.num_heads,
        config.model.feed_forward_dim,
        config.model.num_encoder_blocks,
        config.model.num_renderer_blocks,
    ];
    assert_eq!(sizes.map(|size| size as u32).to_vec(), reference.counts("input.sizes"), "{name}");
    for device in [DeviceName::Flex, DeviceName::Ndarray] {
        config.device = device;
        let path = ModelPath::find(folder).unwrap();
        assert_eq!(path.config().unwrap(), config.model);
        let trained = TrainedModel::open(&path, &config.model, &config.device.open().unwrap()).unwrap();
        let (network, device) = (&trained.network, &trained.device);
        let images = reference.tensor("input.context_images", device);
        let features = network.features(&Views { images, cameras: reference.cameras("context", device) });
        reference.assert_close("output.features", &features);
        let mut tokens = network.normalize(features);
        if trained.has_condenser {
            let [assignment, centroid_index] = ["assignment", "centroid_index"];
            let counts = |name: &str| reference.counts(&format!("input.{name}"));
            let scene = SceneClusters::new(counts(assignment), counts(centroid_index)).unwrap();
            tokens = network.compress(tokens, &Clusters::new(vec![scene]).unwrap().upload(device));
            reference.assert_close("output.clift", &tokens);
        } else {
            assert!(reference.values("output.clift").is_none(), "{name}: the condenser is missing");
        }
        let rendering = network.render(tokens, &reference.cameras("target", device));
        reference.assert_close("output.rendering", &rendering);
    }
}

/// Shapes and bits of every tensor of the network in a checkpoint.
fn network(path: &Path) -> BTreeMap<String, (Vec<u64>, Vec<u32>)> {
    let state = StateDict::open(path).unwrap();
    let keys: Vec<String> = state.keys().filter(|key| key.starts_with(PREFIX)).map(String::from).collect();
    let tensor = |key: String| {
        let shape = state.tensor(&key).unwrap().1.to_vec();
        let bits = state.read(&key).unwrap().into_iter().map(f32::to_bits).collect();
        (key, (shape, bits))
    };
    keys.into_iter().map(tensor).collect()
}

#[test]
fn checkpoints_compute_as_the_twin_and_round_trip() {
    for (name, variant, num_heads) in CHECKPOINTS {
        let place = tempfile::tempdir().unwrap();
        let [folder, again] = ["model", "again"].map(|name| place.path().join(name));
        let file = fixture(&format!("{name}.ckpt"));
        let (config, imported) = import(&file, &folder, &options(variant, num_heads)).unwrap();
        assert_eq!((config.model.variant, imported.variant), (variant, variant));
        assert_eq!(imported.ignored, BTreeMap::from([("perceptual_loss".into(), 2)]));
        assert!(imported.passed_over.contains("project.config.ModelConfig"));
        assert_computes(&folder, name);

        let exported = place.path().join("out.ckpt");
        let model = ModelPath::find(&folder).unwrap();
        let summary = export(&config, &model, ExportFormat::Pytorch, &exported).unwrap();
        assert_eq!(summary.has_condenser, imported.has_condenser);
        let (original, written) = (network(&file), network(&exported));
        assert_eq!(written.keys().collect::<Vec<_>>(), original.keys().collect::<Vec<_>>(), "{name}");
        assert!(written == original, "{name}: shapes or values differ");
        // The export stores the number of heads.
        let other = import(&exported, &again, &options(variant, Some(config.model.num_heads + 2)));
        assert_says(&other.unwrap_err().to_string(), &["`--num-heads` = ", "omit the option", "out.ckpt"]);
        let (_, imported_again) = import(&exported, &again, &options(variant, None)).unwrap();
        assert_eq!(imported_again.convolutions, imported.convolutions);
        assert_computes(&again, name);

        let exported = place.path().join("out.safetensors");
        export(&config, &model, ExportFormat::Safetensors, &exported).unwrap();
        let bytes = std::fs::read(&exported).unwrap();
        let (_, header) = SafeTensors::read_metadata(&bytes).unwrap();
        let metadata = header.metadata().clone().unwrap();
        assert_eq!(metadata["num_heads"], config.model.num_heads.to_string());
        assert_eq!(metadata["dim"], config.model.dim.to_string());
        let third = place.path().join("third.safetensors");
        export(&config, &model, ExportFormat::Safetensors, &third).unwrap();
        assert!(std::fs::read(&third).unwrap() == bytes, "equal weights are equal files");
        let written: BTreeMap<_, _> = SafeTensors::deserialize(&bytes)
            .unwrap()
            .tensors()
            .into_iter()
            .map(|(key, view)| {
                let bits = view.data().as_chunks().0.iter().map(|bytes| u32::from_le_bytes(*bytes)).collect();
                (key, (view.shape().iter().map(|&size| size as u64).collect(), bits))
            })
            .collect();
        assert!(written == original, "{name}: the safetensors file differs");
    }
}

/// Imports a checkpoint with changed tensors and returns the error message.
fn refusal(change: impl Fn(&mut BTreeMap<String, (Vec<usize>, Vec<f32>)>), options: &ImportOptions) -> String {
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("changed.ckpt");
    let mut tensors: BTreeMap<_, _> = network(&fixture("re10k.ckpt"))
        .into_iter()
        .map(|(key, (shape, bits))| {
            let shape: Vec<usize> = shape.into_iter().map(|size| size as usize).collect();
            (key, (shape, bits.into_iter().map(f32::from_bits).collect()))
        })
        .collect();
    change(&mut tensors);
    let tensors: Vec<_> = tensors.into_iter().map(|(key, (shape, values))| (key, shape, values)).collect();
    write_state_dict(&file, &tensors, &[]).unwrap();
    refused(&file, place.path(), options)
}

fn refused(file: &Path, place: &Path, options: &ImportOptions) -> String {
    let before: Vec<_> = std::fs::read_dir(place).unwrap().map(|item| item.unwrap().file_name()).collect();
    let message = import(file, &place.join("model"), options).unwrap_err().to_string();
    let after: Vec<_> = std::fs::read_dir(place).unwrap().map(|item| item.unwrap().file_name()).collect();
    assert_eq!(before, after, "no files are written");
    assert!(message.contains(file.file_name().unwrap().to_str().unwrap()), "{message}");
    message
}

fn re10k() -> ImportOptions {
    options(CliftVariant::ReleasedRe10k, Some(3))
}

#[track_caller]
fn assert_says(message: &str, parts: &[&str]) {
    for part in parts {
        assert!(message.contains(part), "{part}\nis not in\n{message}");
    }
}

/// The network of a fixture under other keys.
fn tensors_of(name: &str, rename: impl Fn(&str) -> String) -> Vec<(String, Vec<usize>, Vec<f32>)> {
    let all = network(&fixture(name)).into_iter().map(|(key, (shape, bits))| {
        let shape = shape.iter().map(|&size| size as usize).collect();
        (rename(&key), shape, bits.into_iter().map(f32::from_bits).collect())
    });
    all.collect()
}

#[test]
fn another_variant_is_named_where_it_fits() {
    let place = tempfile::tempdir().unwrap();
    for (name, wrong, right) in [
        ("dl3dv", CliftVariant::ReleasedRe10k, "--variant released-dl3dv"),
        ("re10k", CliftVariant::ReleasedDl3dv, "--variant released-re10k"),
        ("paper", CliftVariant::ReleasedRe10k, "--variant paper"),
    ] {
        let heads = CHECKPOINTS.iter().find(|(other, ..)| *other == name).unwrap().2.unwrap_or(7);
        let file = fixture(&format!("{name}.ckpt"));
        let message = refused(&file, place.path(), &options(wrong, Some(heads)));
        assert_says(&message, &[right]);
    }
}

#[test]
fn heads_must_divide_the_width() {
    let place = tempfile::tempdir().unwrap();
    let import = |heads| {
        let folder = place.path().join("model");
        import(&fixture("re10k.ckpt"), &folder, &options(CliftVariant::ReleasedRe10k, heads)).unwrap_err().to_string()
    };
    assert_says(
        &import(None),
        &[
            "`--num-heads` = not given: tensor shapes do not determine the number",
            "a divisor of the width 15 (transformer.decoder.layers.0.",
            "re10k.ckpt",
        ],
    );
    assert_says(&import(Some(0)), &["`--num-heads` = 0"]);
    assert_says(&import(Some(4)), &["`--num-heads` = 4", "width 15 (transformer.decoder.layers.0.", "re10k.ckpt"]);
    // Normalised heads show their width.
    let place = tempfile::tempdir().unwrap();
    let message = refused(&fixture("dl3dv.ckpt"), place.path(), &options(CliftVariant::ReleasedDl3dv, Some(2)));
    assert_says(
        &message,
        &["misshapen: transformer.encoder.layers.N.self_attn.q_norm.weight is [2], expected [7] (N = 0, 1, 2)"],
    );
}

#[test]
fn half_precision_needs_conversion() {
    let place = tempfile::tempdir().unwrap();
    let options = options(CliftVariant::ReleasedRe10k, Some(5));
    let message = refused(&fixture("half.ckpt"), place.path(), &options);
    assert_says(
        &message,
        &[
            "not in f32: transformer.linear_input.weight [10, 576] is F16; --convert converts it to f32",
            "is BF16; --convert",
        ],
    );
    let folder = place.path().join("model");
    let (_, imported) = import(&fixture("half.ckpt"), &folder, &ImportOptions { convert: true, ..options }).unwrap();
    assert_eq!(imported.num_converted, imported.parameters.len());
    assert!(imported.ignored.is_empty());
}

#[test]
fn truncated_damaged_and_hostile_files_are_refused() {
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("changed.ckpt");
    let whole = std::fs::read(fixture("re10k.ckpt")).unwrap();
    for length in [0, 1, 1000, whole.len() / 2, whole.len() - 1] {
        std::fs::write(&file, &whole[..length]).unwrap();
        let what = if length == 0 { "an empty file" } else { "is no readable ZIP archive" };
        assert_says(&refused(&file, place.path(), &re10k()), &["bad checkpoint: ", what]);
    }
    // A flipped bit of a weight is found by the archive's checksum.
    let state = StateDict::open(&fixture("re10k.ckpt")).unwrap();
    let weight: Vec<u8> =
        state.read("transformer.linear_input.weight").unwrap().iter().flat_map(|value| value.to_le_bytes()).collect();
    let at = whole.windows(64).position(|window| window == &weight[..64]).unwrap();
    let mut damaged = whole.clone();
    damaged[at + 5] ^= 1;
    std::fs::write(&file, &damaged).unwrap();
    assert_says(&refused(&file, place.path(), &re10k()), &["has another checksum"]);

    let hostile = fixture("../hostile/calls_system.torch");
    let copy = place.path().join("calls_system.torch");
    std::fs::copy(hostile, &copy).unwrap();
    let message = refused(&copy, place.path(), &re10k());
    assert_says(&message, &["which is not on the allow-list; no code was run"]);

    // Values that are not finite.
    let message =
        refusal(|tensors| tensors.get_mut("transformer.output_norm.bias").unwrap().1[3] = f32::INFINITY, &re10k());
    assert_says(&message, &["transformer.output_norm.bias [15]: value 3 is inf"]);
    // Sizes that nobody has.
    let message = refusal(
        |tensors| {
            let all = tensors.clone().into_iter().filter(|(key, _)| key.contains("encoder.layers.0."));
            tensors.extend(all.map(|(key, tensor)| (key.replace(".0.", ".18446744073709551615."), tensor)));
        },
        &re10k(),
    );
    assert!(message.contains("num_encoder_blocks"), "{message}");
}

#[test]
fn an_interrupted_import_leaves_nothing() {
    let place = tempfile::tempdir().unwrap();
    let (folder, stop) = (place.path().join("model"), AtomicBool::new(true));
    let stopped = crate::interchange::import::import(&fixture("re10k.ckpt"), &folder, &re10k(), &stop);
    assert!(matches!(stopped, Err(TrainError::Abandoned { .. })));
    // While it writes, too.
    let kept = place.path().join("kept");
    let (config, imported) = import(&fixture("re10k.ckpt"), &kept, &re10k()).unwrap();
    let stopped = model_dir::write_model_dir(&folder, &config, &[], &imported, &stop);
    assert!(matches!(stopped, Err(TrainError::Abandoned { .. })));
    let left: Vec<_> = std::fs::read_dir(place.path()).unwrap().map(|item| item.unwrap().file_name()).collect();
    assert_eq!(left, ["kept"]);
}

#[test]
fn nothing_that_exists_is_written_over() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path().join("model");
    std::fs::create_dir(&folder).unwrap();
    let message = import(&fixture("re10k.ckpt"), &folder, &re10k()).unwrap_err().to_string();
    assert_says(&message, &["`-o` = ", "the path exists"]);
    assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 0);
}
