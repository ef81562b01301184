//! Initial weights of a stage from another model, and weights between those and the trained ones.

use std::collections::VecDeque;
use std::path::Path;

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::Tensor;
use clift_core::first_few;
use clift_model::{ModelPath, Network, NetworkAdapter, check_condenser, find_shipped, load_adapted, refuse_checkpoint};

use crate::config::config::{Config, Stage2Config};
use crate::error::TrainError;
use crate::events::{Event, Sink, Stage};

/// Loads the initial weights that the config names for a stage: all of stage 1, or the condenser for stage 2. They come from
/// the same stage of another run, from a model directory, a weight file or the [shipped model](find_shipped), maybe through a
/// [`NetworkAdapter`]. Reports which parameters were loaded.
pub(crate) fn init_from(
    mut model: Network,
    config: &Config,
    stage: Stage,
    sink: &mut dyn Sink,
) -> Result<Network, TrainError> {
    let (from, part, what, lack) = if stage == Stage::Stage1 {
        let lack = "no tensor of the file fits this model";
        (&config.stage1.init_from, Network::stage1_part(), "weight file for stage1.init_from", lack)
    } else {
        let lack = "the file has no condenser";
        (&config.stage2.init_from, Network::condenser_part(), "weight file for stage2.init_from", lack)
    };
    let Some(from) = from else { return Ok(model) };
    let from = &*find_shipped(from)?;
    let in_folder = [from.join(stage.name()), from.into()].map(|folder| folder.join("model.safetensors"));
    let [run, _] = &in_folder;
    let path: &Path = if from.is_dir() { in_folder.iter().find(|file| file.exists()).unwrap_or(run) } else { from };
    refuse_checkpoint(path)?;
    // The sizes of a weight file without a config are unknown.
    let mut adapter = NetworkAdapter::default();
    if let Ok(found) = ModelPath::find(path) {
        let found_adapter = NetworkAdapter::find(&config.model, &found.dir)?;
        if stage == Stage::Stage2 {
            // The condenser is the same for longer patches and more blocks, and the other networks are trained.
            check_condenser(&config.model, &found.dir)?;
        } else {
            adapter = found_adapter;
        }
    }
    let mut loaded = load_adapted(&mut model, &part, path, adapter)?;
    if loaded.applied.is_empty() {
        return Err(TrainError::bad_file(what, path)(lack));
    }
    let list = |names: &[String]| match names.len() {
        0 => "none".into(),
        count => format!("{count} ({})", first_few(names)),
    };
    // The rest of the file is not lost where the other stage takes it.
    if stage == Stage::Stage2 || config.stage2.init_from.is_some() {
        loaded.unused.retain(|name| part.matches(name));
    }
    sink.event(&Event::Message(format!(
        "loaded {} parameters from {}{}; initialized, not in the file: {}; unused in the file: {}",
        loaded.applied.len(),
        path.display(),
        adapter.describe().map(|change| format!(", {change}")).unwrap_or_default(),
        list(&loaded.missing),
        list(&loaded.unused)
    )));
    Ok(adapter.close_added_blocks(model))
}

/// Returns the weights at `stage2.weight_interpolation` of the way from the start of stage 2, which are those of stage 1 and
/// of the initial condenser, to its end. `stage1` is called where the position is not the end.
pub(crate) fn stage2_weights(
    config: &Config,
    stage1: impl FnOnce() -> Result<Network, TrainError>,
    trained: Network,
    sink: &mut dyn Sink,
) -> Result<Network, TrainError> {
    let Stage2Config { weight_interpolation: position, init_from: from, .. } = &config.stage2;
    if *position == 1.0 {
        return Ok(trained);
    }
    let mut start = init_from(stage1()?, config, Stage::Stage2, &mut |_: &Event| {})?.valid();
    if from.is_none() {
        // An untrained condenser returns the centroids unchanged, whatever its other weights are.
        start.condenser = trained.condenser.clone().close_gates();
    }
    sink.event(&Event::Message(format!(
        "stage2: saving the weights at {position} of the way from its start; checkpoints and validations have those at its end"
    )));
    Ok(interpolate(&start, trained, *position))
}

/// Returns `start + position * (trained - start)` for every parameter of two modules with the same parameters (WiSE-FT,
/// Wortsman et al., CVPR 2022): on images unlike those of the training, weights in between are often better than both. Equal
/// values stay equal bit for bit, -0 too.
fn interpolate<M: Module>(start: &M, trained: M, position: f64) -> M {
    let mut interpolation = Interpolation { start: VecDeque::new(), position };
    start.visit(&mut interpolation);
    trained.map(&mut interpolation)
}

struct Interpolation {
    /// Parameters in the module's order, flattened.
    start: VecDeque<Tensor<1>>,
    position: f64,
}

impl ModuleVisitor for Interpolation {
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        self.start.push_back(param.val().flatten(0, D - 1));
    }
}

impl ModuleMapper for Interpolation {
    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let start = self.start.pop_front().expect("modules with the same parameters");
        param.map(|trained| {
            let start = start.reshape(trained.dims());
            trained.clone() - (trained - start).mul_scalar(1.0 - self.position)
        })
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;
    use clift_model::{save_weights, weights_hash};

    use super::*;
    use crate::config::parse::read_config;
    use crate::testing::fixture;

    #[test]
    fn a_condenser_of_a_shallower_network_leaves_the_other_networks_as_trained() {
        let folder = tempfile::tempdir().expect("a folder");
        let (mut config, _) = read_config::<Config>(&fixture("../tests/micro.toml"), &[]).expect("valid");
        let shallow = Network::new(&config.model, 3, &Device::flex());
        save_weights(&shallow, &folder.path().join("model.safetensors")).expect("writable");
        let text = toml::to_string(&config).expect("a table");
        std::fs::write(folder.path().join("config.toml"), text).expect("writable");
        config.model.num_encoder_blocks += 1;
        config.model.num_renderer_blocks += 1;
        config.stage2.init_from = Some(folder.path().into());
        let trained = Network::new(&config.model, 4, &Device::flex());
        let mut started = init_from(trained.clone(), &config, Stage::Stage2, &mut |_: &Event| {}).expect("loads");
        assert_eq!(weights_hash(&started.condenser), weights_hash(&shallow.condenser));
        started.condenser = trained.condenser.clone();
        assert_eq!(weights_hash(&started), weights_hash(&trained));
    }
}
