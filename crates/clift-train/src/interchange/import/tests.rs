use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::AtomicBool;

use burn::tensor::{Device, Tensor};
use clift_data::write_state_dict;
use clift_model::{Cameras, CliftVariant, Clusters, DeviceName, ModelPath, PREFIX, SceneClusters, TrainedModel, Views};

use super::*;
use crate::config::parse::read_config;
use crate::testing::{Reference, fixture};

/// Name, variant and heads of every checkpoint that `scripts/fixtures/make_checkpoints.py` wrote.
const CHECKPOINTS: [(&str, CliftVariant, Option<usize>); 5] = [
    ("re10k", CliftVariant::ReleasedRe10k, Some(3)),
    ("re10k_first", CliftVariant::ReleasedRe10k, Some(5)),
    ("dl3dv", CliftVariant::ReleasedDl3dv, None),
    ("dl3dv_one", CliftVariant::ReleasedDl3dv, None),
    ("paper", CliftVariant::Paper, Some(3)),
];

/// Variant and heads.
type Network = (CliftVariant, Option<usize>);

const RE10K: Network = (CliftVariant::ReleasedRe10k, Some(3));

fn import(file: &Path, out: &Path, network: Network) -> Result<(Config, ImportRecord), TrainError> {
    crate::interchange::import::import(file, out, network, &AtomicBool::new(false))
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

#[test]
fn checkpoints_compute_as_the_twin() {
    for (name, variant, num_heads) in CHECKPOINTS {
        let place = tempfile::tempdir().unwrap();
        let folder = place.path().join("model");
        let file = fixture(&format!("checkpoints/{name}.ckpt"));
        let (config, imported) = import(&file, &folder, (variant, num_heads)).unwrap();
        assert_eq!((config.model.variant, imported.variant), (variant, variant));
        assert_eq!(imported.ignored, BTreeMap::from([("perceptual_loss".into(), 2)]));
        assert!(imported.passed_over.contains("project.config.ModelConfig"));
        assert_computes(&folder, name);
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
    write_state_dict(&file, &tensors).unwrap();
    refused(&file, place.path(), RE10K)
}

fn refused(file: &Path, place: &Path, network: Network) -> String {
    let before: Vec<_> = std::fs::read_dir(place).unwrap().map(|item| item.unwrap().file_name()).collect();
    let message = import(file, &place.join("model"), network).unwrap_err().to_string();
    let after: Vec<_> = std::fs::read_dir(place).unwrap().map(|item| item.unwrap().file_name()).collect();
    assert_eq!(before, after, "no files are written");
    assert!(message.contains(file.file_name().unwrap().to_str().unwrap()), "{message}");
    message
}

fn refused_fixture(name: &str, network: Network) -> String {
    refused(&fixture(&format!("checkpoints/{name}.ckpt")), tempfile::tempdir().unwrap().path(), network)
}

/// The tensors of the network in a checkpoint, under other keys.
fn re10k_tensors(rename: impl Fn(&str) -> String) -> Vec<HostTensor> {
    let state = StateDict::open(&fixture("checkpoints/re10k.ckpt")).unwrap();
    let tensor = |key: &str| {
        let shape = state.tensor(key).unwrap().1.iter().map(|&size| size as usize).collect();
        (rename(key), shape, state.read(key).unwrap())
    };
    state.keys().filter(|key| key.starts_with(PREFIX)).map(tensor).collect()
}

#[track_caller]
fn assert_says(message: &str, parts: &[&str]) {
    for part in parts {
        assert!(message.contains(part), "{part}\nis not in\n{message}");
    }
}

#[test]
fn another_variant_is_named_where_it_fits() {
    for (name, heads, wrong, right) in [
        ("dl3dv", 7, CliftVariant::ReleasedRe10k, "--variant released-dl3dv"),
        ("paper", 3, CliftVariant::ReleasedRe10k, "--variant paper"),
    ] {
        assert_says(&refused_fixture(name, (wrong, Some(heads))), &[right]);
    }
}

#[test]
fn heads_must_divide_the_width() {
    let import = |heads| refused_fixture("re10k", (CliftVariant::ReleasedRe10k, heads));
    assert_says(
        &import(None),
        &["`--num-heads` = not given: tensor shapes do not determine the number: give a divisor"],
    );
    assert_says(&import(Some(0)), &["`--num-heads` = 0"]);
    assert_says(&import(Some(4)), &["`--num-heads` = 4", "re10k.ckpt"]);
    // Normalised heads show their width.
    let expected = "misshapen: transformer.encoder.layers.N.self_attn.q_norm.weight is [2], expected [7] (3 keys)";
    assert_says(&refused_fixture("dl3dv", (CliftVariant::ReleasedDl3dv, Some(2))), &[expected]);
}

#[test]
fn half_precision_is_converted() {
    let place = tempfile::tempdir().unwrap();
    let folder = place.path().join("model");
    let network = (CliftVariant::ReleasedRe10k, Some(5));
    let (_, imported) = import(&fixture("checkpoints/half.ckpt"), &folder, network).unwrap();
    assert_eq!(imported.num_converted, imported.parameters.len());
    assert!(imported.ignored.is_empty());
}

// `tests/src/attack` damages whole files.
#[test]
fn values_and_sizes_that_nobody_has_are_refused() {
    let message = refusal(|tensors| tensors.get_mut("transformer.output_norm.bias").unwrap().1[3] = f32::INFINITY);
    assert_says(&message, &["transformer.output_norm.bias [15]: value 3 is inf"]);
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
    let stopped = crate::interchange::import::import(&fixture("checkpoints/re10k.ckpt"), &folder, RE10K, &stop);
    assert!(matches!(stopped, Err(TrainError::Abandoned { .. })));
    let kept = place.path().join("kept");
    import(&fixture("checkpoints/re10k.ckpt"), &kept, RE10K).unwrap();
    let left: Vec<_> = std::fs::read_dir(place.path()).unwrap().map(|item| item.unwrap().file_name()).collect();
    assert_eq!(left, ["kept"]);
    let message = import(&fixture("checkpoints/re10k.ckpt"), &kept, RE10K).unwrap_err().to_string();
    assert_says(&message, &["`-o` = ", "the path exists"]);
}

#[test]
fn missing_and_unknown_keys_are_listed() {
    let message = refusal(|tensors| {
        let tensor = tensors.remove("transformer.encoder.layers.0.norm1.weight").unwrap();
        tensors.insert("transformer.encoder.layers.0.norm_1.weight".into(), tensor);
    });
    assert_says(
        &message,
        &[
            "the checkpoint is not a released-re10k network (width 15, 3 heads, 1 + 2 layers); no files were written",
            "missing: transformer.encoder.layers.0.norm1.weight [15]\n",
            "unknown: transformer.encoder.layers.0.norm_1.weight [15]\n",
        ],
    );
    // A missing layer is not taken for a smaller network: all its keys are listed.
    let message = refusal(|tensors| tensors.retain(|key, _| !key.contains("decoder.layers.0")));
    assert_says(&message, &["missing: transformer.decoder.layers.0.self_attn.in_proj_weight [45, 15]"]);
    assert_eq!(message.matches("missing: transformer.decoder.layers.0.").count(), 18, "{message}");
    // An incomplete condenser is not taken for a first-stage checkpoint.
    let message = refusal(|tensors| tensors.retain(|key, _| !key.contains("squeezer.linear1")));
    let [weight, bias] =
        ["weight [15, 15]", "bias [15]"].map(|rest| format!("missing: transformer.squeezer.linear1.{rest}"));
    assert_says(&message, &[&weight, &bias]);
    // Equal problems of all layers are one line.
    assert_says(
        &refusal_of(re10k_tensors(|key| key.replace(".norm2.weight", ".ln_2.scale"))),
        &[
            "missing: transformer.decoder.layers.N.norm2.weight [15] (2 keys)\n",
            "unknown: transformer.decoder.layers.N.ln_2.scale [15] (2 keys)\n",
            "unknown: transformer.encoder.layers.0.ln_2.scale [15]\n",
        ],
    );
}

#[test]
fn unknown_and_misshapen_tensors_are_reported_alone() {
    let message = refusal(|tensors| {
        tensors.insert("transformer.decoder.layers.3.norm1.weight".into(), (vec![15], vec![0.0; 15]));
    });
    assert_says(&message, &["1 + 2 layers", "unknown: transformer.decoder.layers.3.norm1.weight [15]\n"]);
    assert!(!message.contains("missing"), "{message}");
    for changes in [
        &[("output_norm.weight", &[14][..], "[14], expected [15]")][..],
        &[("linear_input.weight", &[15, 576, 3, 3], "[15, 576, 3, 3], expected [15, 576]")],
        &[
            ("squeezer.linear1.weight", &[15, 14], "[15, 14], expected [15, 15]"),
            ("linear_target.weight", &[15, 96, 2, 2], "[15, 96, 2, 2], expected [15, 384]"),
        ],
    ] {
        let message = refusal(|tensors| {
            for (key, shape, _) in changes {
                let tensor = (shape.to_vec(), vec![0.0; shape.iter().product()]);
                assert!(tensors.insert(format!("transformer.{key}"), tensor).is_some());
            }
        });
        for (key, _, shapes) in changes {
            assert_says(&message, &[&format!("misshapen: transformer.{key} is {shapes}")]);
        }
        assert_eq!(message.matches("misshapen").count(), changes.len(), "{message}");
    }
}

#[test]
fn prefixes_are_removed_and_other_keys_skipped() {
    for lead in ["module.transformer.", "transformer._orig_mod.", "module."] {
        let place = tempfile::tempdir().unwrap();
        let (file, out) = (place.path().join("changed.ckpt"), place.path().join("model"));
        let mut tensors = re10k_tensors(|key| key.replace("transformer.", lead));
        tensors.push(("module.perceptual_loss.vgg.0.weight".into(), vec![1], vec![0.0]));
        let ema = [0, 1].map(|layer| (format!("ema.encoder.layers.{layer}.norm1.weight"), vec![1], vec![0.0]));
        tensors.extend(ema.into_iter().filter(|_| lead != "module."));
        write_state_dict(&file, &tensors).unwrap();
        let (_, imported) = import(&file, &out, RE10K).unwrap();
        assert_eq!(imported.ignored, BTreeMap::from([("perceptual_loss".into(), 1)]));
        if lead != "module." {
            assert_eq!(imported.outside, BTreeMap::from([("ema.encoder.layers.N.norm1.weight".into(), 2)]));
        }
        assert_computes(&out, "re10k");
    }
}
