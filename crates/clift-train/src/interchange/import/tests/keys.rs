//! Missing, unknown, stray and renamed keys.

use super::*;

fn renaming(renames: &[(&str, &str)]) -> ImportOptions {
    let renames = renames.iter().map(|&(from, to)| (from.to_owned(), to.to_owned())).collect();
    ImportOptions { renames, ..re10k() }
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
            "--rename FROM=TO",
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
fn stray_and_misshapen_tensors_are_reported_alone() {
    let message = refusal(|tensors| {
        tensors.insert("transformer.decoder.layers.3.norm1.weight".into(), (vec![15], vec![0.0; 15]));
    });
    assert_says(&message, &["1 + 2 layers", "unknown: transformer.decoder.layers.3.norm1.weight [15]\n"]);
    assert!(!message.contains("missing"), "{message}");
    for changes in [
        &[("output_norm.weight", &[14][..], "[14], expected [15]")][..],
        &[("encoder.layers.0.linear1.weight", &[15, 22], "[15, 22], expected [22, 15]")],
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
fn network_keys_outside_the_prefix_are_refused() {
    let outside = |from: &str| {
        let short = |key: &str| match key.strip_prefix("transformer.") {
            Some(short) if short.starts_with(from) => short.to_owned(),
            _ => key.to_owned(),
        };
        refusal_of(re10k_tensors(short))
    };
    for (from, key) in [
        ("squeezer.", "squeezer.linear1.weight [15, 15]"),
        ("linear_target", "linear_target.bias [15]"),
        ("output_norm", "output_norm.bias [15]"),
        ("encoder.layers.0.norm1", "encoder.layers.0.norm1.bias [15]"),
    ] {
        assert_says(&outside(from), &[&format!("beside transformer.: {key}"), "--rename FROM=TO"]);
    }

    let place = tempfile::tempdir().unwrap();
    let (file, out) = (place.path().join("changed.ckpt"), place.path().join("model"));
    let mut tensors = re10k_tensors(str::to_owned);
    for layer in 0..2 {
        tensors.push((format!("ema.encoder.layers.{layer}.norm1.weight"), vec![1], vec![0.0]));
    }
    tensors.push(("module.perceptual_loss.vgg.0.weight".into(), vec![1], vec![0.0]));
    write_state_dict(&file, &tensors, &[]).unwrap();
    let (_, imported) = import(&file, &out, &re10k()).unwrap();
    assert_eq!(imported.ignored, BTreeMap::from([("perceptual_loss".into(), 1)]));
    assert_eq!(imported.outside, BTreeMap::from([("ema.encoder.layers.N.norm1.weight".into(), 2)]));
}

#[test]
fn prefixes_are_removed_and_renames_applied() {
    let none: &[(&str, &str)] = &[];
    let gate = &[("squeezer.gate", "squeezer.linear1")];
    for (lead, linear1, renames) in [
        ("module.transformer.", "linear1", none),
        ("_orig_mod.transformer.", "linear1", none),
        ("transformer.module.", "linear1", none),
        ("transformer._orig_mod.", "gate", gate),
        ("module.", "linear1", none),
    ] {
        let place = tempfile::tempdir().unwrap();
        let (file, out) = (place.path().join("changed.ckpt"), place.path().join("model"));
        let rename =
            |key: &str| key.replace("squeezer.linear1", &format!("squeezer.{linear1}")).replace("transformer.", lead);
        write_state_dict(&file, &re10k_tensors(rename), &[]).unwrap();
        if !renames.is_empty() {
            refused(&file, place.path(), &re10k());
        }
        import(&file, &out, &renaming(renames)).unwrap();
        assert_computes(&out, "re10k");
    }
}

#[test]
fn renames_apply_to_whole_keys_or_fail() {
    let place = tempfile::tempdir().unwrap();
    let (file, out) = (place.path().join("changed.ckpt"), place.path().join("model"));
    write_state_dict(&file, &re10k_tensors(|key| key.replace("transformer.", "net.")), &[]).unwrap();
    let renamed = |renames: &[(&str, &str)]| import(&file, &out, &renaming(renames));
    let message = renamed(&[("net.", "transformer."), ("net.encoder", "encoder")]).unwrap_err().to_string();
    assert_says(&message, &["`--rename` = net.encoder=encoder: no key contains \"net.encoder\"", "changed.ckpt"]);
    let message = renamed(&[("net.output_norm", "transformer.output")]).unwrap_err().to_string();
    assert_says(&message, &["unknown: net.output_norm.weight [15], renamed transformer.output.weight"]);
    renamed(&[("net.", "transformer.")]).unwrap();
    assert_computes(&out, "re10k");
}
