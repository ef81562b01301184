//! Settings of an evaluation, taken from a config.

use clift_data::derive_seed;
use clift_eval::{Method, Sweep};
use clift_model::{DeviceName, TokenCount};

use crate::config::config::Config;

/// Returns the settings of an evaluation, without LPIPS and external methods.
pub(crate) fn eval_sweep(config: &Config, storage: Vec<TokenCount>, methods: Vec<Method>) -> Sweep {
    let Config { seed, eval, clusters, model, device, .. } = config;
    Sweep {
        storage,
        render: eval.render.clone(),
        selection: eval.selection,
        tokens: eval.tokens.clone(),
        methods,
        kmeans: clusters.kmeans.clone(),
        model: model.clone(),
        lpips: None,
        external_methods: Vec::new(),
        is_cpu: matches!(device, DeviceName::Flex | DeviceName::Ndarray),
        seed: derive_seed(*seed, "eval"),
    }
}
