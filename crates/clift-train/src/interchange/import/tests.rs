use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::AtomicBool;

use burn::tensor::{Device, Tensor};
use clift_data::write_state_dict;
use clift_model::{
    Cameras, CliftVariant, Clusters, DeviceName, ModelPath, Network, PREFIX, SceneClusters, TrainedModel, Views,
    save_weights,
};
use half::f16;
use safetensors::SafeTensors;

use super::*;
use crate::config::parse::read_config;
use crate::interchange::export::{ExportFormat, export};
use crate::testing::{Reference, fixture};

mod keys;

/// Name, variant and heads of every checkpoint that `scripts/fixtures/make_checkpoints.py` wrote.
const CHECKPOINTS: [(&str, CliftVariant, Option<usize>); 5] = [
    ("re10k", CliftVariant::ReleasedRe10k, Some(3)),
    ("re10k_first", CliftVariant::ReleasedRe10k, Some(5)),
    ("dl3dv", CliftVariant::ReleasedDl3dv, None),
    ("dl3dv_one", CliftVariant::ReleasedDl3dv, None),
    ("paper", CliftVariant::Paper, Some(3)),
];

fn import(file: &Path, out: &Path, options: &ImportOptions) -> Result<(Config, ImportRecord), TrainError> {
    crate::interchange::import::import(file, out, options, &AtomicBool::new(false))
}

fn options(variant: CliftVariant, num_heads: Option<usize>) -> ImportOptions {
    ImportOptions { variant, num_heads, convert: false, renames: Vec::new() }
}

fn cameras(reference: &Reference, kind: &str, device: &Device) -> Cameras {
    let input = |part: &str| format!("input.{kind}_{part}");
    let (c2w, intrinsics) = (reference.tensor(&input("c2w"), device), reference.tensor(&input("intrinsics"), device));
    Cameras { height: 16, width: 24, c2w, intrinsics }
}

#[track_caller]
fn assert_close<const D: usize>(reference: &Reference, name: &str, got: &Tensor<D>) {
    let expected: Tensor<D> = reference.tensor(name, &got.device());
    assert_eq!(got.dims(), expected.dims(), "{name}");
    let error = (got.clone() - expected).abs().max().into_scalar::<f32>();
    // Values up to about 5 through at most four blocks in f32.
    assert!(error <= 1e-4, "{name} differs by {error:.2e}");
}

/// Compares features, condensed tokens and images of an imported model with those of the twin, on every CPU device.
fn assert_computes(folder: &Path, name: &str) {
    let reference = Reference::open(&format!("checkpoints/{name}"));
    let (mut config, _) = read_config::<Config>(&folder.join("config.toml"), &[]).unwrap();
    let sizes = [
        config.model.dim,
        config.model.num_heads,
        config.model.feed_forward_dim,
        config.model.num_encoder_blocks,
        config.model.num_renderer_blocks,
    ];
    assert_eq!(sizes.map(|size| size as f64).to_vec(), reference.values("input.sizes"), "{name}");
    for device in [DeviceName::Flex, DeviceName::Ndarray] {
        config.device = device;
        let path = ModelPath::find(folder).unwrap();
        assert_eq!(path.config().unwrap(), config.model);
        let trained = TrainedModel::open_with(&path, &config.model, &config.device.open().unwrap()).unwrap();
        let (network, device) = (&trained.network, &trained.device);
        let images = reference.tensor("input.context_images", device);
        let features = network.features(&Views { images, cameras: cameras(&reference, "context", device) });
        assert_close(&reference, "output.features", &features.values);
        let mut tokens = network.normalize(features);
        if trained.has_condenser {
            let [assignment, centroid_index] = ["input.assignment", "input.centroid_index"]
                .map(|name| reference.values(name).into_iter().map(|index| index as u32).collect());
            let scene = SceneClusters::new(assignment, centroid_index).unwrap();
            tokens = network.compress(tokens, &Clusters::new(vec![scene]).unwrap().upload(device));
            assert_close(&reference, "output.clift", &tokens.values);
        } else {
            assert!(reference.data("output.clift").is_none(), "{name}: the condenser is missing");
        }
        let rendering = network.render(tokens, &cameras(&reference, "target", device));
        assert_close(&reference, "output.rendering", &rendering);
    }
}

/// The tensors of the network in a checkpoint, under other keys.
fn network(path: &Path, rename: impl Fn(&str) -> String) -> Vec<HostTensor> {
    let state = StateDict::open(path).unwrap();
    let tensor = |key: &str| {
        let shape = state.tensor(key).unwrap().1.iter().map(|&size| size as usize).collect();
        (rename(key), shape, state.read(key).unwrap())
    };
    state.keys().filter(|key| key.starts_with(PREFIX)).map(tensor).collect()
}

fn bits(tensors: Vec<HostTensor>) -> BTreeMap<String, (Vec<usize>, Vec<u32>)> {
    let bits = |values: Vec<f32>| values.into_iter().map(f32::to_bits).collect();
    tensors.into_iter().map(|(key, shape, values)| (key, (shape, bits(values)))).collect()
}

#[test]
fn checkpoints_compute_as_the_twin_and_round_trip() {
    for (name, variant, num_heads) in CHECKPOINTS {
        let place = tempfile::tempdir().unwrap();
        let [folder, again] = ["model", "again"].map(|name| place.path().join(name));
        let file = fixture(&format!("checkpoints/{name}.ckpt"));
        let (config, imported) = import(&file, &folder, &options(variant, num_heads)).unwrap();
        assert_eq!((config.model.variant, imported.variant), (variant, variant));
        assert_eq!(imported.ignored, BTreeMap::from([("perceptual_loss".into(), 2)]));
        assert!(imported.passed_over.contains("project.config.ModelConfig"));
        assert_computes(&folder, name);

        let exported = place.path().join("out.ckpt");
        let model = ModelPath::find(&folder).unwrap();
        let summary = export(&config, &model, ExportFormat::Pytorch, &exported).unwrap();
        assert_eq!(summary.has_condenser, imported.has_condenser);
        let [original, written] = [&file, &exported].map(|path| bits(network(path, str::to_owned)));
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
        let read = |bytes: &[u8]| {
            let tensors = SafeTensors::deserialize(bytes).unwrap().tensors().into_iter();
            let values =
                |data: &[u8]| data.as_chunks().0.iter().map(|bytes| u32::from_le_bytes(*bytes)).collect::<Vec<u32>>();
            tensors.map(|(key, view)| (key, (view.shape().to_vec(), values(view.data())))).collect::<BTreeMap<_, _>>()
        };
        assert!(original == read(&bytes), "{name}: the safetensors file differs");

        // A model directory in f16, exported again, has the rounded values.
        let half = place.path().join("half");
        let from_half = place.path().join("half.safetensors");
        let summary = export(&config, &model, ExportFormat::F16, &half).unwrap();
        assert_eq!(summary.has_condenser, imported.has_condenser);
        export(&config, &ModelPath::find(&half).unwrap(), ExportFormat::Safetensors, &from_half).unwrap();
        let round = |bits: &mut u32| *bits = f16::from_f32(f32::from_bits(*bits)).to_f32().to_bits();
        let mut rounded = original;
        for (_, values) in rounded.values_mut() {
            values.iter_mut().for_each(round);
        }
        assert!(rounded == read(&std::fs::read(&from_half).unwrap()), "{name}: the values in f16 differ");
    }
}

type Tensors = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

/// Imports a checkpoint with changed tensors and returns the error message.
fn refusal(change: impl Fn(&mut Tensors)) -> String {
    let tensors = re10k_tensors(str::to_owned).into_iter();
    let mut tensors = tensors.map(|(key, shape, values)| (key, (shape, values))).collect();
    change(&mut tensors);
    refusal_of(tensors.into_iter().map(|(key, (shape, values))| (key, shape, values)).collect())
}

fn refusal_of(tensors: Vec<HostTensor>) -> String {
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("changed.ckpt");
    write_state_dict(&file, &tensors, &[]).unwrap();
    refused(&file, place.path(), &re10k())
}

fn refused(file: &Path, place: &Path, options: &ImportOptions) -> String {
    let before: Vec<_> = std::fs::read_dir(place).unwrap().map(|item| item.unwrap().file_name()).collect();
    let message = import(file, &place.join("model"), options).unwrap_err().to_string();
    let after: Vec<_> = std::fs::read_dir(place).unwrap().map(|item| item.unwrap().file_name()).collect();
    assert_eq!(before, after, "no files are written");
    assert!(message.contains(file.file_name().unwrap().to_str().unwrap()), "{message}");
    message
}

fn refused_fixture(name: &str, options: &ImportOptions) -> String {
    refused(&fixture(&format!("checkpoints/{name}.ckpt")), tempfile::tempdir().unwrap().path(), options)
}

fn re10k() -> ImportOptions {
    options(CliftVariant::ReleasedRe10k, Some(3))
}

fn re10k_tensors(rename: impl Fn(&str) -> String) -> Vec<HostTensor> {
    network(&fixture("checkpoints/re10k.ckpt"), rename)
}

#[track_caller]
fn assert_says(message: &str, parts: &[&str]) {
    for part in parts {
        assert!(message.contains(part), "{part}\nis not in\n{message}");
    }
}

#[test]
fn exports_of_new_models_have_the_published_shapes() {
    let place = tempfile::tempdir().unwrap();
    for (name, variant, num_heads) in
        CHECKPOINTS.into_iter().filter(|(name, ..)| ["re10k", "dl3dv", "paper"].contains(name))
    {
        let published = StateDict::open(&fixture(&format!("checkpoints/{name}.ckpt"))).unwrap();
        let imported = place.path().join(name);
        let (config, _) = import(&published.path, &imported, &options(variant, num_heads)).unwrap();
        // A model that was never imported.
        let weights = place.path().join(format!("{name}.safetensors"));
        save_weights(&Network::new(&config.model, 0, &Device::flex()), &weights).unwrap();
        let model = ModelPath { dir: place.path().into(), weights };
        let out = place.path().join(format!("{name}.ckpt"));
        export(&config, &model, ExportFormat::Pytorch, &out).unwrap();
        let shapes = |state: &StateDict| -> BTreeMap<String, Vec<u64>> {
            let keys = state.keys().filter(|key| key.starts_with(PREFIX));
            keys.map(|key| (key.to_owned(), state.tensor(key).unwrap().1.to_vec())).collect()
        };
        let exported = shapes(&StateDict::open(&out).unwrap());
        assert_eq!(exported, shapes(&published), "{name}");
        let dim = config.model.dim as u64;
        assert_eq!(exported["transformer.patch_to_image.0.weight"], [192, dim, 1, 1]);
    }
}

#[test]
fn another_variant_is_named_where_it_fits() {
    for (name, wrong, right) in [
        ("dl3dv", CliftVariant::ReleasedRe10k, "--variant released-dl3dv"),
        ("re10k", CliftVariant::ReleasedDl3dv, "--variant released-re10k"),
        ("paper", CliftVariant::ReleasedRe10k, "--variant paper"),
    ] {
        let heads = CHECKPOINTS.iter().find(|(other, ..)| *other == name).unwrap().2.unwrap_or(7);
        assert_says(&refused_fixture(name, &options(wrong, Some(heads))), &[right]);
    }
}

#[test]
fn heads_must_divide_the_width() {
    let import = |heads| refused_fixture("re10k", &options(CliftVariant::ReleasedRe10k, heads));
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
    assert_says(
        &refused_fixture("dl3dv", &options(CliftVariant::ReleasedDl3dv, Some(2))),
        &["misshapen: transformer.encoder.layers.N.self_attn.q_norm.weight is [2], expected [7] (3 keys)"],
    );
}

#[test]
fn half_precision_needs_conversion() {
    let place = tempfile::tempdir().unwrap();
    let options = options(CliftVariant::ReleasedRe10k, Some(5));
    assert_says(
        &refused_fixture("half", &options),
        &[
            "not in f32: transformer.linear_input.weight [10, 576] is F16; --convert converts it to f32",
            "is BF16; --convert",
        ],
    );
    let folder = place.path().join("model");
    let (_, imported) =
        import(&fixture("checkpoints/half.ckpt"), &folder, &ImportOptions { convert: true, ..options }).unwrap();
    assert_eq!(imported.num_converted, imported.parameters.len());
    assert!(imported.ignored.is_empty());
}

#[test]
fn truncated_damaged_and_hostile_files_are_refused() {
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("changed.ckpt");
    let whole = std::fs::read(fixture("checkpoints/re10k.ckpt")).unwrap();
    for length in [0, 1, 1000, whole.len() / 2, whole.len() - 1] {
        std::fs::write(&file, &whole[..length]).unwrap();
        let what = if length == 0 { "an empty file" } else { "is not a readable ZIP archive" };
        assert_says(&refused(&file, place.path(), &re10k()), &["bad checkpoint: ", what]);
    }
    // A flipped bit of a weight is found by the archive's checksum.
    let state = StateDict::open(&fixture("checkpoints/re10k.ckpt")).unwrap();
    let weight: Vec<u8> =
        state.read("transformer.linear_input.weight").unwrap().iter().flat_map(|value| value.to_le_bytes()).collect();
    let at = whole.windows(64).position(|window| window == &weight[..64]).unwrap();
    let mut damaged = whole.clone();
    damaged[at + 5] ^= 1;
    std::fs::write(&file, &damaged).unwrap();
    assert_says(&refused(&file, place.path(), &re10k()), &["has another checksum"]);

    let copy = place.path().join("calls_system.torch");
    std::fs::copy(fixture("hostile/calls_system.torch"), &copy).unwrap();
    assert_says(&refused(&copy, place.path(), &re10k()), &["which is not on the allow-list; no code was run"]);

    // Values that are not finite.
    let message = refusal(|tensors| tensors.get_mut("transformer.output_norm.bias").unwrap().1[3] = f32::INFINITY);
    assert_says(&message, &["transformer.output_norm.bias [15]: value 3 is inf"]);
    // Sizes that nobody has.
    let message = refusal(|tensors| {
        let all = tensors.clone().into_iter().filter(|(key, _)| key.contains("encoder.layers.0."));
        tensors.extend(all.map(|(key, tensor)| (key.replace(".0.", ".18446744073709551615."), tensor)));
    });
    assert!(message.contains("num_encoder_blocks"), "{message}");
}

#[test]
fn an_interrupted_import_leaves_nothing() {
    let place = tempfile::tempdir().unwrap();
    let (folder, stop) = (place.path().join("model"), AtomicBool::new(true));
    let stopped = crate::interchange::import::import(&fixture("checkpoints/re10k.ckpt"), &folder, &re10k(), &stop);
    assert!(matches!(stopped, Err(TrainError::Abandoned { .. })));
    // While it writes, too.
    let kept = place.path().join("kept");
    let (config, imported) = import(&fixture("checkpoints/re10k.ckpt"), &kept, &re10k()).unwrap();
    let stopped = model_dir::write_model_dir(&folder, &config, &[], (&imported, "re10k.ckpt".as_ref()), &stop);
    assert!(matches!(stopped, Err(TrainError::Abandoned { .. })));
    let left: Vec<_> = std::fs::read_dir(place.path()).unwrap().map(|item| item.unwrap().file_name()).collect();
    assert_eq!(left, ["kept"]);
}

#[test]
fn nothing_that_exists_is_written_over() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path().join("model");
    std::fs::create_dir(&folder).unwrap();
    let message = import(&fixture("checkpoints/re10k.ckpt"), &folder, &re10k()).unwrap_err().to_string();
    assert_says(&message, &["`-o` = ", "the path exists"]);
    assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 0);
}
