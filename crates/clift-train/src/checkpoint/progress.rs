//! `state.json` of a checkpoint: position in training, and checksums of the other files.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::Path;

use clift_core::replace_file;
use clift_model::ModelConfig;
use serde::{Deserialize, Serialize};

use crate::error::TrainError;
use crate::step::loss_scale::LossScale;
use crate::step::step_guard::LossHistory;
use crate::version::parse_versioned;

pub(crate) const STATE: &str = "state.json";
pub(crate) const VERSION: u32 = 4;

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct State {
    pub version: u32,
    pub progress: TrainingPosition,
    /// Checksums of the other files, by name.
    pub files: BTreeMap<String, Fingerprint>,
    /// Config of the network; `None` for checkpoints that were opened without one.
    pub model: Option<ModelConfig>,
    /// Loss scale of training with f16 products.
    pub loss_scale: Option<LossScale>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Fingerprint {
    pub num_bytes: u64,
    crc32: u32,
}

/// Position in training. With the weights and the optimizer state it determines the rest of the run: batches, schedules
/// and random streams are functions of the seed and the step.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingPosition {
    /// Updates made, including the skipped ones.
    pub step: u64,
    /// Consecutive updates that were skipped just before.
    pub bad_steps: u32,
    /// All skipped updates.
    pub num_bad_steps: u64,
    /// The last step with a finished validation; 0 for none.
    pub validated: u64,
    /// Loss and gradient norm of the last good steps, with which the next step is compared.
    pub recent: LossHistory,
}

impl State {
    /// Reads `state.json` of a checkpoint.
    pub fn read(folder: &Path) -> Result<Self, TrainError> {
        let path = folder.join(STATE);
        let text = std::fs::read(&path).map_err(TrainError::io("reading a checkpoint", &path))?;
        parse_versioned(&text, VERSION).map_err(TrainError::bad_file("checkpoint", &path))
    }

    pub fn write(&self, folder: &Path) -> Result<(), TrainError> {
        let path = folder.join(STATE);
        let text = serde_json::to_vec(self).map_err(TrainError::bad_file("checkpoint", &path))?;
        replace_file(&path, &text).map_err(TrainError::io("writing a checkpoint", &path))
    }
}

impl Fingerprint {
    pub fn of(path: &Path) -> std::io::Result<Self> {
        let mut file = File::open(path)?;
        let mut hasher = crc32fast::Hasher::new();
        let (mut num_bytes, mut buffer) = (0, vec![0; 1 << 20]);
        loop {
            match file.read(&mut buffer)? {
                0 => return Ok(Self { num_bytes, crc32: hasher.finalize() }),
                count => {
                    hasher.update(&buffer[..count]);
                    num_bytes += count as u64;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_round_trip_bit_for_bit() {
        let mut bits = 0x1234_5678_9abc_def0_u64;
        let any = std::iter::repeat_with(|| {
            bits = bits.wrapping_mul(0x5851_f42d_4c95_7f2d).wrapping_add(0x1405_7b7e_f767_814f);
            f64::from_bits(bits)
        });
        let extreme = [0.0, -0.0, f64::MAX, f64::MIN_POSITIVE, f64::from_bits(1), 1e23, 9_007_199_254_740_993.0];
        for value in any.take(200_000).filter(|number| number.is_finite()).chain(extreme) {
            let mut history = LossHistory::default();
            history.push(value, value);
            let text = serde_json::to_string(&history).unwrap();
            let read: LossHistory = serde_json::from_str(&text).unwrap();
            // As texts, 0 and -0 differ.
            assert_eq!(serde_json::to_string(&read).unwrap(), text);
        }
    }

    #[test]
    fn files_of_other_versions_are_refused() {
        let message = parse_versioned::<State>(br#"{"version":3}"#, VERSION).unwrap_err();
        assert_eq!(message, "version 3, this clift reads version 4; the clift that wrote the file reads it");
    }
}
