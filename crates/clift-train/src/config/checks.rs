//! Checks of a config beyond its types: ranges, and values that depend on each other.

use clift_core::{BadConfig, check_config};
use clift_data::{DataConfig, SourceKind, Split};
use clift_model::{Grouping, PERCEPTUAL_MIN_SIZE_PX};

use crate::config::config::{Config, MAX_TOKENS, OptimizerConfig};
use crate::error::{TrainError, bad};
use crate::events::Stage;

impl Config {
    /// Checks ranges, and values that depend on each other.
    pub fn validate(&self) -> Result<(), TrainError> {
        let has_run_dir = !self.run_dir.as_os_str().is_empty();
        check_config(has_run_dir, "run_dir", "\"\"", || "write the directory of the run".into())?;
        self.model.validate()?;
        self.data.views.validate().map_err(|error| error.in_section("data.views"))?;
        self.validate_size()?;
        self.validate_further_sizes()?;
        self.validate_token_counts()?;
        validate_data(&self.data)?;
        self.validate_loss()?;
        check_config(self.data.hold_out != 1, "data.hold_out", 1, || {
            "no frame would be left to train on: write 2 or more, or 0 for none".into()
        })?;
        let Self { stage1, stage2, clusters, eval, checkpoint, .. } = self;
        for settings in [Stage::Stage1, Stage::Stage2].map(|stage| self.stage(stage)) {
            let name = settings.stage.name();
            in_range(&format!("{name}.batch_size"), settings.batch_size, 1, 65_536)?;
            in_range(&format!("{name}.accumulate"), settings.accumulate, 1, settings.batch_size)?;
            settings.optimizer.validate().map_err(|error| error.in_section(&format!("{name}.optimizer")))?;
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
        for (key, counts) in [("clusters.grid", &clusters.grid), ("eval.stored_tokens", &eval.stored_tokens)] {
            check_config(!counts.is_empty(), key, "[]", || "write at least one count".into())?;
        }
        let [low, high] = stage1.keep_tokens;
        let keep_tokens = |is_valid: bool, fix: &str| {
            check_config(is_valid, "stage1.keep_tokens", format!("[{low}, {high}]"), || fix.into())
        };
        keep_tokens(low > 0.0 && low <= high && high <= 1.0, "write 0 < smallest <= largest <= 1")?;
        let architecture = self.model.architecture;
        let all_tokens = format!("model.architecture = \"{architecture}\" renders from all tokens: write [1.0, 1.0]");
        keep_tokens(architecture.supports_clusters() || low == 1.0, &all_tokens)?;
        let (half, share) = (stage1.half_resolution, 0.0..=1.0);
        let (tolerance, factor, weight) =
            (clusters.kmeans.tolerance, stage2.renderer_lr_factor, stage2.weight_interpolation);
        for (key, value, is_valid, fix) in [
            ("stage1.half_resolution", half, share.contains(&half), "write 0 to 1"),
            ("clusters.kmeans.tolerance", tolerance, (0.0..1.0).contains(&tolerance), "write 0 or a small fraction"),
            ("stage2.renderer_lr_factor", factor, share.contains(&factor), "write 0 to 1"),
            ("stage2.weight_interpolation", weight, weight > 0.0 && weight <= 1.0, "write a number above 0, at most 1"),
        ] {
            check_config(is_valid, key, value, || fix.into())?;
        }
        Ok(())
    }

    fn validate_further_sizes(&self) -> Result<(), BadConfig> {
        let (patch_size, most) = (self.model.patch_size, self.data.width.saturating_mul(self.data.height));
        for size in &self.stage1.further_sizes {
            let check = |is_valid: bool, fix: String| {
                check_config(is_valid, "stage1.further_sizes", format!("{size:?}"), || fix)
            };
            let has_patches = size.iter().all(|&side| side > 0 && side.is_multiple_of(patch_size));
            check(has_patches, format!("write multiples of model.patch_size = {patch_size}"))?;
            let fix = format!("write a size of at most {most} pixels, as data.width x data.height");
            check(size[0].saturating_mul(size[1]) <= most, fix)?;
            let has_enough =
                self.loss.perceptual_weight == 0.0 || size.iter().all(|&side| side >= PERCEPTUAL_MIN_SIZE_PX);
            let fix = "write longer sides, or loss.perceptual_weight = 0";
            check(has_enough, format!("VGG-19 needs {PERCEPTUAL_MIN_SIZE_PX} pixels: {fix}"))?;
        }
        Ok(())
    }

    fn validate_size(&self) -> Result<(), BadConfig> {
        let patch_size = self.model.patch_size;
        for (key, value) in [("data.width", self.data.width), ("data.height", self.data.height)] {
            check_config(value > 0 && value.is_multiple_of(patch_size), key, value, || {
                let below = value / patch_size * patch_size;
                let near =
                    if below == 0 { patch_size.to_string() } else { format!("{below} or {}", below + patch_size) };
                format!("write a multiple of model.patch_size = {patch_size}, such as {near}")
            })?;
        }
        Ok(())
    }

    /// Checks that images of half the width and height have a size that stage 1 can train on, if `stage1.half_resolution` is
    /// above 0. [`Self::validate`] does not: a trained model is used without such images.
    pub fn validate_half_resolution(&self) -> Result<(), TrainError> {
        let half = self.stage1.half_resolution;
        let (multiple, least) = (2 * self.model.patch_size, 2 * PERCEPTUAL_MIN_SIZE_PX);
        let further = self.stage1.further_sizes.iter().flatten().map(|&side| ("stage1.further_sizes", side));
        let sides = [("data.width", self.data.width), ("data.height", self.data.height)].into_iter().chain(further);
        for (key, value) in sides.filter(|_| half > 0.0) {
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
    fn validate_loss(&self) -> Result<(), BadConfig> {
        let weight = self.loss.perceptual_weight;
        let is_weight = weight >= 0.0 && weight.is_finite();
        check_config(is_weight, "loss.perceptual_weight", weight, || "write 0 or a positive number".into())?;
        let (width, height) = (self.data.width, self.data.height);
        let (is_large, least) = (width.min(height) >= PERCEPTUAL_MIN_SIZE_PX, PERCEPTUAL_MIN_SIZE_PX);
        check_config(weight == 0.0 || is_large, "loss.perceptual_weight", weight, || {
            format!("VGG-19 needs images of at least {least} x {least}, not {width} x {height}: write 0")
        })
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
            for (key, count) in grid.chain([("eval.validation_stored_tokens", &self.eval.validation_stored_tokens)]) {
                let too_few = |views: usize| count.of(views * tokens_per_view).is_ok_and(|count| count < views);
                if too_few(views.min_context) || too_few(views.max_context) {
                    return Err(bad(key, count, "write at least one tile for every context view"));
                }
            }
        }
        Ok(())
    }
}

fn validate_data(data: &DataConfig) -> Result<(), BadConfig> {
    in_range("data.num_threads", data.num_threads.unwrap_or(0), 0, 1024)?;
    in_range("data.num_prefetch", data.num_prefetch, 1, 1024)?;
    if data.source != SourceKind::Synthetic {
        check_config(data.root.is_some(), "data.root", "missing", || {
            "write the folder of the data set or capture".into()
        })?;
        return data.filters.validate().map_err(|error| error.in_section("data.filters"));
    }
    if let Some(root) = data.root.as_ref().filter(|root| !root.as_os_str().is_empty()) {
        let fix = "synthetic scenes are read from no folder: write data.source = \"auto\", or remove the key";
        return Err(BadConfig::new("data.root", root.display(), fix));
    }
    let synthetic = &data.synthetic;
    synthetic.validate().map_err(|error| error.in_section("data.synthetic"))?;
    if synthetic.width < data.width || synthetic.height < data.height {
        let fix = format!(
            "synthetic scenes are {} x {}: write data.synthetic.width and data.synthetic.height of at least {} and {}",
            synthetic.width, synthetic.height, data.width, data.height
        );
        return Err(BadConfig::new("data.width, data.height", format!("{}, {}", data.width, data.height), fix));
    }
    check_config(synthetic.split == Split::default(), "data.synthetic.split", synthetic.split, || {
        "remove the key: a run trains on one split and evaluates on the other".into()
    })
}

impl OptimizerConfig {
    fn validate(&self) -> Result<(), BadConfig> {
        let Self { betas, weight_decay, spike_factor, .. } = *self;
        for (key, value) in [("learning_rate", self.learning_rate), ("max_grad_norm", self.max_grad_norm)] {
            check_config(value > 0.0 && value.is_finite(), key, value, || "write a positive number".into())?;
        }
        check_config(betas.iter().all(|beta| (0.0..1.0).contains(beta)), "betas", format!("{betas:?}"), || {
            "write two numbers of at least 0, below 1".into()
        })?;
        check_config(weight_decay >= 0.0 && weight_decay.is_finite(), "weight_decay", weight_decay, || {
            "write 0 or a positive number".into()
        })?;
        let is_factor = spike_factor == 0.0 || (spike_factor > 1.0 && spike_factor.is_finite());
        check_config(is_factor, "spike_factor", spike_factor, || {
            "write 0 to disable spike detection, or a number above 1".into()
        })?;
        in_range("max_bad_steps", self.max_bad_steps as usize, 1, usize::MAX)
    }
}

fn in_range(key: &str, value: usize, least: usize, most: usize) -> Result<(), BadConfig> {
    check_config((least..=most).contains(&value), key, value, || match most {
        usize::MAX => format!("write at least {least}"),
        _ => format!("write {least} to {most}"),
    })
}
