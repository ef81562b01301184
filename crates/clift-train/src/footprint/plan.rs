//! `clift plan`: counted parameters and memory of a run before it starts.
//!
//! Memory is counted from the tensors that the operations store for the backward.
//! `docs/results/performance.md` compares plans with measured runs.

use clift_eval::available_bytes;
use clift_model::{DeviceName, Parameters};
use serde::Serialize;

use crate::config::config::Config;
use crate::error::TrainError;
use crate::events::RunStep;
use crate::footprint::memory::peak_bytes;

/// Estimate of a run in one process.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Plan {
    /// Device of the tensors.
    pub device: DeviceName,
    /// Threads of the CPU devices.
    pub threads: usize,
    /// Parameters of the networks.
    pub parameters: Parameters,
    /// Tokens of a training scene, fewest and most.
    pub num_tokens: [usize; 2],
    /// Free memory of the device; `None` if the system does not report it.
    pub available_bytes: Option<u64>,
    /// The steps of the run in their order.
    pub parts: Vec<PartPlan>,
}

/// Estimate of one step of a run.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PartPlan {
    /// `stage1`, `clusters`, `stage2` or `eval`.
    pub part: &'static str,
    /// Number of trained parameters.
    pub trained_parameters: u64,
    /// Peak memory of the process.
    pub peak_bytes: u64,
}

/// Estimates a run of `config`.
pub fn plan(config: &Config) -> Result<Plan, TrainError> {
    check_plan(config)?;
    let parameters = Parameters::of(&config.model);
    let (views, [height, width]) = (&config.data.views, [config.data.height, config.data.width]);
    let num_tokens = |num_context| config.model.num_tokens(num_context, height, width);
    let part = |&run_step: &RunStep| {
        let trained_parameters = match run_step {
            RunStep::Train(stage) => parameters.of_parts(stage.trained()),
            RunStep::Clusters | RunStep::Eval => 0,
        };
        Ok(PartPlan { part: run_step.name(), trained_parameters, peak_bytes: peak_bytes(config, run_step)? })
    };
    Ok(Plan {
        device: config.device,
        threads: rayon::current_num_threads(),
        num_tokens: [num_tokens(views.min_context)?, num_tokens(views.max_context)?],
        available_bytes: available_bytes(config.device),
        parts: config.run_steps().iter().map(part).collect::<Result<_, TrainError>>()?,
        parameters,
    })
}

/// Does [`Config::validate`] and [`Config::validate_half_resolution`] without requiring `data.root`.
pub fn check_plan(config: &Config) -> Result<(), TrainError> {
    let mut config = config.clone();
    config.data.root.get_or_insert_with(Default::default);
    config.validate()?;
    config.validate_half_resolution()
}

#[cfg(test)]
mod tests {
    use clift_data::SourceKind;

    use super::*;

    #[test]
    fn plan_has_all_parts_without_data() {
        let mut config = Config { run_dir: "run".into(), ..Config::default() };
        config.data.source = SourceKind::Chunks;
        let plan = plan(&config).expect("valid");
        assert!(plan.parts.iter().map(|part| part.part).eq(["stage1", "clusters", "stage2", "eval"]));
        assert!(plan.parts.iter().all(|part| part.peak_bytes > 300 << 20));
        assert_eq!(plan.parts[0].trained_parameters, 81_239_232);
    }
}
