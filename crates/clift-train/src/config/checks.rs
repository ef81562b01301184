//! Checks of a config beyond its types: ranges, and values that depend on each other.

use clift_data::{DataConfig, DataError, SourceKind, Split};
use clift_eval::PERCEPTUAL_MIN_SIZE_PX;
use clift_model::Grouping;

use crate::config::config::{Config, MAX_TOKENS, OptimizerConfig};
use crate::error::{TrainError, bad};
use crate::events::Stage;

impl Config {
    /// Checks ranges, and values that depend on each other.
    ///
    /// # Errors
    /// [`TrainError::BadConfig`] with key, value and fix.
    pub fn validate(&self) -> Result<(), TrainError> {
        if self.run_dir.as_os_str().is_empty() {
            return Err(bad("run_dir", "\"\"", "write the directory of the run"));
        }
        self.model.validate()?;
        self.data.views.validate().map_err(in_section("data.views"))?;
        self.validate_size()?;
        self.validate_token_counts()?;
        validate_data(&self.data)?;
        self.validate_loss()?;
        if self.data.hold_out == 1 {
            return Err(bad("data.hold_out", 1, "no frame would be left to train on: write 2 or more, or 0 for none"));
        }
        let Self { stage1, stage2, clusters, eval, checkpoint, .. } = self;
        for settings in [Stage::Stage1, Stage::Stage2].map(|stage| self.stage(stage)) {
            let name = settings.stage.name();
            in_range(&format!("{name}.batch_size"), settings.batch_size, 1, usize::MAX)?;
            in_range(&format!("{name}.accumulate"), settings.accumulate, 1, settings.batch_size)?;
            settings.optimizer.validate(name)?;
        }
        for (key, value, least, most) in [
            ("clusters.num_passes", clusters.num_passes, 1, usize::MAX),
            ("clusters.kmeans.max_iterations", clusters.kmeans.max_iterations, 1, usize::MAX),
            ("eval.num_context", eval.num_context, 2, 10_000),
            ("eval.num_targets", eval.num_targets, 1, 10_000),
            ("eval.num_validation_scenes", eval.num_validation_scenes, 1, usize::MAX),
            ("checkpoint.keep", checkpoint.keep, 1, usize::MAX),
        ] {
            in_range(key, value, least, most)?;
        }
        if checkpoint.keep_every > 0
            && (checkpoint.every == 0 || !checkpoint.keep_every.is_multiple_of(checkpoint.every))
        {
            let fix = format!("write 0 or a multiple of checkpoint.every, which is {}", checkpoint.every);
            return Err(bad("checkpoint.keep_every", checkpoint.keep_every, &fix));
        }
        for (key, counts) in [("clusters.grid", &clusters.grid), ("eval.storage", &eval.storage)] {
            if counts.is_empty() {
                return Err(bad(key, "[]", "write at least one count"));
            }
        }
        if !(0.0..=1.0).contains(&stage1.half_resolution) {
            return Err(bad("stage1.half_resolution", stage1.half_resolution, "write 0 to 1"));
        }
        let [low, high] = stage1.keep_tokens;
        if !(low > 0.0 && low <= high && high <= 1.0) {
            return Err(bad("stage1.keep_tokens", format!("[{low}, {high}]"), "write 0 < smallest <= largest <= 1"));
        }
        let architecture = self.model.architecture;
        if !architecture.supports_clusters() && low < 1.0 {
            let fix = format!("model.architecture = \"{architecture}\" renders from all tokens: write [1.0, 1.0]");
            return Err(bad("stage1.keep_tokens", format!("[{low}, {high}]"), &fix));
        }
        if !(0.0..1.0).contains(&clusters.kmeans.tolerance) {
            return Err(bad("clusters.kmeans.tolerance", clusters.kmeans.tolerance, "write 0 or a small fraction"));
        }
        if !(0.0..=1.0).contains(&stage2.renderer_lr_factor) {
            return Err(bad("stage2.renderer_lr_factor", stage2.renderer_lr_factor, "write 0 to 1"));
        }
        let interpolation = stage2.weight_interpolation;
        if !(interpolation > 0.0 && interpolation <= 1.0) {
            return Err(bad("stage2.weight_interpolation", interpolation, "write a number above 0, at most 1"));
        }
        Ok(())
    }

    fn validate_size(&self) -> Result<(), TrainError> {
        let patch_size = self.model.patch_size;
        for (key, value) in [("data.width", self.data.width), ("data.height", self.data.height)] {
            if value == 0 || !value.is_multiple_of(patch_size) {
                let below = value / patch_size * patch_size;
                let near =
                    if below == 0 { patch_size.to_string() } else { format!("{below} or {}", below + patch_size) };
                let fix = format!("write a multiple of model.patch_size = {patch_size}, such as {near}");
                return Err(bad(key, value, &fix));
            }
        }
        Ok(())
    }

    /// Checks that images of half the width and height have a size that stage 1 can train on, if `stage1.half_resolution` is
    /// above 0. [`Self::validate`] does not: a trained model is used without such images.
    ///
    /// # Errors
    /// [`TrainError::BadConfig`] if half of a side has no whole number of patches or is too short for the perceptual loss.
    pub fn validate_half_resolution(&self) -> Result<(), TrainError> {
        let half = self.stage1.half_resolution;
        if half == 0.0 {
            return Ok(());
        }
        let (multiple, least) = (2 * self.model.patch_size, 2 * PERCEPTUAL_MIN_SIZE_PX);
        for (key, value) in [("data.width", self.data.width), ("data.height", self.data.height)] {
            if !value.is_multiple_of(multiple) {
                let fix = format!("write 0, or a multiple of 2 x model.patch_size = {multiple} as {key}, not {value}");
                return Err(bad("stage1.half_resolution", half, &fix));
            }
            if self.loss.perceptual_weight > 0.0 && value < least {
                let needs = format!("VGG-19 needs {PERCEPTUAL_MIN_SIZE_PX} pixels");
                let fix = format!("write 0, or {least} or more as {key}, not {value}: {needs}");
                return Err(bad("stage1.half_resolution", half, &fix));
            }
        }
        Ok(())
    }

    /// Checks weights and sizes of the loss. The VGG weights are checked when training starts.
    fn validate_loss(&self) -> Result<(), TrainError> {
        let weight = self.loss.perceptual_weight;
        if !(weight >= 0.0 && weight.is_finite()) {
            return Err(bad("loss.perceptual_weight", weight, "write 0 or a positive number"));
        }
        let (width, height) = (self.data.width, self.data.height);
        if weight > 0.0 && width.min(height) < PERCEPTUAL_MIN_SIZE_PX {
            let fix = format!(
                "VGG-19 needs images of at least {PERCEPTUAL_MIN_SIZE_PX} x {PERCEPTUAL_MIN_SIZE_PX}, not {width} x {height}: write 0"
            );
            return Err(bad("loss.perceptual_weight", weight, &fix));
        }
        Ok(())
    }

    fn validate_token_counts(&self) -> Result<(), TrainError> {
        let views = &self.data.views;
        let tokens_per_view = self.model.num_patches(1, self.data.height, self.data.width)?;
        let most_tokens = views.max_context.saturating_mul(tokens_per_view);
        if most_tokens > MAX_TOKENS {
            let fix = format!("{most_tokens} tokens exceed {MAX_TOKENS}: write fewer or smaller views");
            return Err(bad("data.views.max_context", views.max_context, &fix));
        }
        let fewest_tokens = views.min_context * tokens_per_view;
        if let Some(count) = self.clusters.grid.iter().find(|count| count.of(fewest_tokens).is_err()) {
            return Err(bad("clusters.grid", count, &format!("a scene has as few as {fewest_tokens} tokens")));
        }
        if self.clusters.grouping == Grouping::Tile {
            let grid = self.clusters.grid.iter().map(|count| ("clusters.grid", count));
            for (key, count) in grid.chain([("eval.validation_storage", &self.eval.validation_storage)]) {
                let too_few = |views: usize| count.of(views * tokens_per_view).is_ok_and(|count| count < views);
                if too_few(views.min_context) || too_few(views.max_context) {
                    return Err(bad(key, count, "write at least one tile for every context view"));
                }
            }
        }
        Ok(())
    }
}

fn validate_data(data: &DataConfig) -> Result<(), TrainError> {
    in_range("data.num_threads", data.num_threads, 0, 1024)?;
    in_range("data.num_prefetch", data.num_prefetch, 1, 1024)?;
    if data.source == SourceKind::Synthetic {
        if let Some(root) = data.root.as_ref().filter(|root| !root.as_os_str().is_empty()) {
            let fix = "synthetic scenes are read from no folder: write data.source = \"auto\", or remove the key";
            return Err(bad("data.root", root.display(), fix));
        }
        return validate_synthetic(data);
    }
    if data.root.is_none() {
        return Err(bad("data.root", "missing", "write the folder of the data set or capture"));
    }
    data.image_cache.validate().map_err(in_section("data.image_cache"))?;
    data.filters.validate().map_err(in_section("data.filters"))
}

fn validate_synthetic(data: &DataConfig) -> Result<(), TrainError> {
    let synthetic = &data.synthetic;
    synthetic.validate().map_err(in_section("data.synthetic"))?;
    if synthetic.width < data.width || synthetic.height < data.height {
        let fix = format!(
            "synthetic scenes are {} x {}: write data.synthetic.width and data.synthetic.height of at least {} and {}",
            synthetic.width, synthetic.height, data.width, data.height
        );
        return Err(bad("data.width, data.height", format!("{}, {}", data.width, data.height), &fix));
    }
    if synthetic.split != Split::default() {
        let fix = "remove the key: a run trains on one split and evaluates on the other";
        return Err(bad("data.synthetic.split", synthetic.split, fix));
    }
    Ok(())
}

impl OptimizerConfig {
    fn validate(&self, stage: &str) -> Result<(), TrainError> {
        for (key, value) in [("learning_rate", self.learning_rate), ("max_grad_norm", self.max_grad_norm)] {
            if !(value > 0.0 && value.is_finite()) {
                return Err(bad(&format!("{stage}.optimizer.{key}"), value, "write a positive number"));
            }
        }
        if !self.betas.iter().all(|beta| (0.0..1.0).contains(beta)) {
            let value = format!("{:?}", self.betas);
            return Err(bad(&format!("{stage}.optimizer.betas"), value, "write two numbers of at least 0, below 1"));
        }
        if !(self.weight_decay >= 0.0 && self.weight_decay.is_finite()) {
            let key = format!("{stage}.optimizer.weight_decay");
            return Err(bad(&key, self.weight_decay, "write 0 or a positive number"));
        }
        if !(self.spike_factor == 0.0 || (self.spike_factor > 1.0 && self.spike_factor.is_finite())) {
            let key = format!("{stage}.optimizer.spike_factor");
            return Err(bad(&key, self.spike_factor, "write 0 to disable spike detection, or a number above 1"));
        }
        in_range(&format!("{stage}.optimizer.max_bad_steps"), self.max_bad_steps as usize, 1, usize::MAX)
    }
}

fn in_range(key: &str, value: usize, least: usize, most: usize) -> Result<(), TrainError> {
    if (least..=most).contains(&value) {
        return Ok(());
    }
    let fix = if most == usize::MAX { format!("write at least {least}") } else { format!("write {least} to {most}") };
    Err(bad(key, value, &fix))
}

/// Adds the section to the key of an error; for `map_err`.
fn in_section(section: &'static str) -> impl FnOnce(DataError) -> TrainError {
    move |error| match error {
        // The problem has the form "is VALUE; FIX".
        DataError::BadConfig { key, problem } => match problem.strip_prefix("is ").and_then(|is| is.split_once("; ")) {
            Some((value, fix)) => bad(&format!("{section}.{key}"), value, fix),
            None => DataError::BadConfig { key: format!("{section}.{key}"), problem }.into(),
        },
        other => other.into(),
    }
}
