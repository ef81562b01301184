//! Options of synthetic scenes and their valid ranges.

use serde::{Deserialize, Serialize};

use crate::scene_source::Split;
use clift_core::{BadConfig, check_config};

/// Largest number of scenes of one source, whose keys take some 60 MB.
const MAX_SCENES: usize = 1_000_000;

/// Kind of synthetic scenes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Look {
    /// Rooms with boxes and balls in plain patterns.
    #[default]
    Rooms,
    /// Scenes with the statistics of photos: interiors, places outdoors, things; fields of view from 40 to 100 degrees.
    Real,
    /// Those of `real` with frames that differ as photos do; every eighth scene is one of `rooms`.
    Mixed,
}

/// Options of synthetic scenes. Lengths are in units of the scene; a default room is 3 to 4 units wide.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SyntheticConfig {
    /// Kind of scenes: `"rooms"`, or `"real"`, which has the statistics of photos and samples all that the keys from
    /// `fov_deg` on set for rooms, or `"mixed"`: every eighth scene is one of `rooms`, the others are of `real` with arcs up
    /// to half a circle and frames that differ in roll (up to 30 degrees), focal length (25 %) and exposure (0.8 stops).
    pub look: Look,
    /// Seed of all scenes. Different seeds share no scene.
    pub seed: u64,
    /// Split, `"train"` or `"test"`. The splits share no scene, for any seed.
    pub split: Split,
    /// Number of scenes, up to a million. Unused scenes cost only their keys.
    pub num_scenes: usize,
    /// Number of frames along each camera path.
    pub num_frames: usize,
    /// Columns of a frame.
    pub width: usize,
    /// Rows of a frame.
    pub height: usize,
    /// Horizontal field of view in degrees, up to 100. Pixels are square.
    pub fov_deg: f64,
    /// Length of the camera path from the first to the last frame, without small swings; longer is harder.
    pub path_length: f64,
    /// Cycles of the wall patterns per unit of length; finer is harder. Patterns on objects are twice as fine.
    pub texture_frequency: f64,
    /// Share of empty rooms with one colour per wall, for scenes of different complexity.
    pub plain_share: f64,
    /// Strength of highlights and reflections, which depend on the view: 0 is matt, 1 is polished.
    pub specular: f64,
    /// Rays per pixel, a square number.
    pub samples_per_pixel: usize,
}

impl Default for SyntheticConfig {
    fn default() -> Self {
        Self {
            look: Look::Rooms,
            seed: 0,
            split: Split::Train,
            num_scenes: 10_000,
            num_frames: 16,
            width: 32,
            height: 32,
            fov_deg: 75.0,
            path_length: 4.0,
            texture_frequency: 0.4,
            plain_share: 0.0,
            specular: 0.4,
            samples_per_pixel: 4,
        }
    }
}

impl SyntheticConfig {
    /// Checks every field.
    pub fn validate(&self) -> Result<(), BadConfig> {
        for (key, count, most) in [
            ("num_scenes", self.num_scenes, MAX_SCENES),
            ("num_frames", self.num_frames, 100_000),
            ("width", self.width, 16_384),
            ("height", self.height, 16_384),
        ] {
            check_config((1..=most).contains(&count), key, count, || format!("use 1 to {most}"))?;
        }
        for (key, value, low, high) in [
            ("fov_deg", self.fov_deg, 10.0, 100.0),
            ("path_length", self.path_length, 0.01, 1_000.0),
            ("texture_frequency", self.texture_frequency, 0.0, 100.0),
            ("plain_share", self.plain_share, 0.0, 1.0),
            ("specular", self.specular, 0.0, 1.0),
        ] {
            check_config((low..=high).contains(&value), key, value, || format!("use {low} to {high}"))?;
        }
        if self.look == Look::Real {
            self.check_unset()?;
        }
        let samples = self.samples_per_pixel;
        let is_square = samples.isqrt().pow(2) == samples;
        check_config((1..=256).contains(&samples) && is_square, "samples_per_pixel", samples, || {
            "use a square number such as 1, 4, 9 or 16".into()
        })
    }

    /// Checks that no key is set that has a meaning for rooms only.
    fn check_unset(&self) -> Result<(), BadConfig> {
        let [own, unset] = [self, &Self::default()].map(|config| serde_json::to_value(config).unwrap_or_default());
        for key in ["fov_deg", "path_length", "texture_frequency", "plain_share", "specular", "samples_per_pixel"] {
            let fix = || "look = \"real\" does not use it: remove the key".into();
            check_config(own[key] == unset[key], key, &own[key], fix)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn invalid_value_is_named_with_its_key() {
        type Change = fn(&mut SyntheticConfig);
        let cases: [(Change, &str); 5] = [
            (|c| c.num_frames = 0, "`num_frames` = 0: use 1 to 100000"),
            (|c| c.num_scenes = MAX_SCENES + 1, "`num_scenes` = 1000001"),
            (|c| c.fov_deg = f64::NAN, "`fov_deg` = NaN"),
            (|c| c.path_length = f64::INFINITY, "`path_length` = inf"),
            (|c| c.samples_per_pixel = 6, "`samples_per_pixel` = 6"),
        ];
        for (change, expected) in cases {
            let mut config = SyntheticConfig::default();
            change(&mut config);
            let message = config.validate().unwrap_err().to_string();
            assert!(message.starts_with(expected), "{message}");
        }
    }
}
