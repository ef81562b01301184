//! Filters of the scenes of a data set.

use serde::{Deserialize, Serialize};

use crate::error::DataError;
use clift_core::{BadConfig, check_config};

/// Filters of the scenes of a data set. Skipped scenes are listed in the skip report.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SceneFilters {
    /// Smallest number of frames; 0 keeps all scenes. The paper trains on scenes of 46 frames and more.
    pub min_frames: usize,
    /// Largest field of view of any frame, in degrees; pixelSplat skips scenes above 100.
    pub max_fov_deg: Option<f64>,
}

impl SceneFilters {
    /// Checks every field.
    pub fn validate(&self) -> Result<(), BadConfig> {
        let Some(limit) = self.max_fov_deg else { return Ok(()) };
        check_config(limit.is_finite() && limit > 0.0, "max_fov_deg", limit, || {
            "use a positive number such as 100".into()
        })
    }

    /// Returns whether filtering reads the scenes.
    pub(crate) fn is_any_set(&self) -> bool {
        *self != Self::default()
    }

    /// Returns the reason to skip a scene. `fov_deg` returns the largest field of view of any frame, in degrees.
    pub(crate) fn reason_to_skip(
        &self,
        num_frames: usize,
        fov_deg: impl FnOnce() -> Result<f64, DataError>,
    ) -> Result<Option<String>, DataError> {
        if num_frames < self.min_frames {
            return Ok(Some(format!("shorter than the {} frames of data.filters.min_frames", self.min_frames)));
        }
        let Some(limit) = self.max_fov_deg else { return Ok(None) };
        Ok((fov_deg()? > limit).then(|| format!("with a field of view above {limit} degrees")))
    }
}
