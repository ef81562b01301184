//! What was measured of each view, and `views.csv`.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use clift_data::files::replace;
use clift_model::TokenStorage;
use serde::{Deserialize, Serialize};

use crate::error::EvalError;
use crate::method::SystemName;
use crate::selection::Selection;

/// How a view was made.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Variant {
    /// Clusters, condensed: the method.
    Clift,
    /// The tokens nearest to the cluster centres, without the condenser.
    Kmeans,
    /// The tokens in the middle of rectangular tiles of the context views, without a condenser.
    Patch,
    /// The same behind a condenser that was trained on tiles.
    PatchClift,
    /// A random subset of all tokens.
    Random,
    /// Baseline: the nearest context view.
    NearestView,
    /// Baseline: the mean of the context views.
    MeanImage,
    /// Pictures of another system.
    #[serde(untagged)]
    System(SystemName),
}

impl Variant {
    /// The name in files and tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::System(name) => name.as_str(),
            Self::Clift => "clift",
            Self::Kmeans => "kmeans",
            Self::Patch => "patch",
            Self::PatchClift => "patch_clift",
            Self::Random => "random",
            Self::NearestView => "nearest_view",
            Self::MeanImage => "mean_image",
        }
    }
}

/// One setting that views are averaged over. The order is that of the files: variant, then fewer tokens.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Setting {
    /// How its views were made.
    pub variant: Variant,
    /// Tokens in the scene file; 0 for a baseline.
    pub num_storage_tokens: usize,
    /// Tokens the renderer was given; 0 for a baseline.
    pub num_render_tokens: usize,
    /// Number format of the stored tokens; none where there are none.
    pub tokens: Option<TokenStorage>,
}

impl Setting {
    /// The setting of a baseline or of another system, which has no tokens.
    pub const fn baseline(variant: Variant) -> Self {
        Self { variant, num_storage_tokens: 0, num_render_tokens: 0, tokens: None }
    }

    /// Name of the number format, empty where there is none.
    pub fn format_name(self) -> &'static str {
        self.tokens.map_or("", TokenStorage::name)
    }
}

/// One measured view; `None` is what was not measured.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measured {
    /// Peak signal-to-noise ratio in dB; infinite for an identical picture.
    pub psnr: f64,
    /// Structural similarity; `None` below 11 x 11 pixels.
    pub ssim: Option<f64>,
    /// LPIPS with VGG-16; `None` without its weights and below 16 x 16 pixels.
    pub lpips_vgg: Option<f64>,
    /// Seconds the renderer took for this view alone, from tokens to pixels.
    pub render_s: Option<f64>,
    /// Seconds token selection took.
    pub select_s: Option<f64>,
}

impl Measured {
    /// Time per frame: choosing tokens, where that was done, and drawing.
    pub fn frame_s(&self) -> Option<f64> {
        self.render_s.map(|render_s| render_s + self.select_s.unwrap_or_default())
    }

    /// Only PSNR and SSIM.
    pub const fn quality(psnr: f64, ssim: Option<f64>) -> Self {
        Self { psnr, ssim, lpips_vgg: None, render_s: None, select_s: None }
    }
}

/// What a setting costs whatever the view; `None` is what was not computed.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Cost {
    /// Billions of multiply-accumulates per rendered view, attention included.
    pub gflops: Option<f64>,
    /// Bytes of a scene file, or the data size that was given for another system.
    pub scene_bytes: Option<u64>,
    /// Most memory of the process while a view was drawn, everything in it included.
    pub peak_bytes: Option<u64>,
}

/// Something that a summary has no number of.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct NotMeasured {
    /// Name of the number.
    pub metric: String,
    /// Why, and what to do about it.
    pub reason: String,
}

/// Views of one setting, by scene key and target frame.
pub(crate) type ViewsOfSetting = BTreeMap<(String, usize), Measured>;

/// Collects measured views, in any order: the files depend only on what was measured.
#[derive(Clone, Debug, Default)]
pub struct Accumulator {
    pub(crate) views: BTreeMap<Setting, ViewsOfSetting>,
    pub(crate) costs: BTreeMap<Setting, Cost>,
    pub(crate) skipped: BTreeSet<String>,
    /// Share of the token variance within clusters, by scene and count.
    pub(crate) cluster_errors: BTreeMap<(String, usize), f64>,
    pub(crate) not_measured: Vec<NotMeasured>,
    pub(crate) missing: BTreeMap<SystemName, BTreeSet<String>>,
    pub(crate) lpips_sha256: Option<String>,
    /// How rendered tokens were chosen, where they were.
    pub(crate) selection: Option<Selection>,
    warm: BTreeSet<Setting>,
}

impl Accumulator {
    /// Adds one view of a scene.
    ///
    /// # Errors
    /// [`EvalError::DuplicateView`] when the same view of the same setting is there already.
    pub fn add(&mut self, scene: &str, frame: usize, setting: Setting, view: Measured) -> Result<(), EvalError> {
        match self.views.entry(setting).or_default().entry((scene.to_owned(), frame)) {
            Entry::Vacant(entry) => {
                entry.insert(view);
                Ok(())
            }
            Entry::Occupied(_) => {
                let Setting { variant, num_storage_tokens: stored, num_render_tokens: rendered, .. } = setting;
                let variant = variant.name();
                let view = format!("{variant} of {scene}, frame {frame}, {stored} stored, {rendered} rendered");
                Err(EvalError::DuplicateView { view })
            }
        }
    }

    /// Whether a view of a setting has been added.
    pub fn contains(&self, scene: &str, frame: usize, setting: Setting) -> bool {
        self.views.get(&setting).is_some_and(|views| views.contains_key(&(scene.to_owned(), frame)))
    }

    /// Notes what a setting costs.
    pub fn set_cost(&mut self, setting: Setting, cost: Cost) {
        self.costs.insert(setting, cost);
    }

    /// Notes the size of a scene's file; of scenes with different numbers of context views the largest counts.
    pub fn add_scene_bytes(&mut self, setting: Setting, bytes: u64) {
        let cost = self.costs.entry(setting).or_default();
        cost.scene_bytes = cost.scene_bytes.max(Some(bytes));
    }

    /// Notes what drawing a view costs.
    pub fn add_gflops(&mut self, setting: Setting, gflops: f64) {
        self.costs.entry(setting).or_default().gflops = Some(gflops);
    }

    /// Whether a view of a setting has been drawn before those that are timed.
    pub(crate) fn is_warm(&self, setting: Setting) -> bool {
        self.warm.contains(&setting)
    }

    /// Notes that one has, with the memory it took.
    pub(crate) fn set_warm(&mut self, setting: Setting, peak_bytes: Option<u64>) {
        self.warm.insert(setting);
        self.costs.entry(setting).or_default().peak_bytes = peak_bytes;
    }

    /// Notes why there is no number.
    pub fn note_not_measured(&mut self, metric: &str, reason: String) {
        self.not_measured.push(NotMeasured { metric: metric.into(), reason });
    }

    /// Notes which weights LPIPS has.
    pub fn set_lpips_weights(&mut self, sha256: &str) {
        self.lpips_sha256 = Some(sha256.into());
    }

    /// Notes a picture that another system does not have.
    pub fn miss(&mut self, system: SystemName, picture: String) {
        self.missing.entry(system).or_default().insert(picture);
    }

    /// Notes a scene that was left out.
    pub fn skip(&mut self, scene: &str) {
        self.skipped.insert(scene.to_owned());
    }

    /// Writes `views.csv`: a row per view and setting, baselines included; an empty field was not measured,
    /// and an identical picture has the PSNR `inf`.
    ///
    /// # Errors
    /// [`EvalError::Io`] when the folder cannot be written.
    pub fn write_views(&self, path: &Path) -> Result<(), EvalError> {
        let failed = |source| EvalError::Io { action: "writing the measured views", source, path: path.to_owned() };
        let text = |value: Option<f64>| value.map(|value| value.to_string()).unwrap_or_default();
        let mut csv = csv::Writer::from_writer(Vec::new());
        let mut write = |row: [&str; 11]| csv.write_record(row).map_err(|error| failed(error.into()));
        write(VIEW_COLUMNS)?;
        for (setting, views) in &self.views {
            let (stored, rendered) = (setting.num_storage_tokens.to_string(), setting.num_render_tokens.to_string());
            for ((scene, frame), view) in views {
                write([
                    scene,
                    &frame.to_string(),
                    setting.variant.name(),
                    &stored,
                    &rendered,
                    &view.psnr.to_string(),
                    &text(view.ssim),
                    &text(view.lpips_vgg),
                    &text(view.render_s),
                    &text(view.select_s),
                    setting.format_name(),
                ])?;
            }
        }
        let content = csv.into_inner().map_err(|error| failed(error.into_error()))?;
        replace(path, &content).map_err(failed)
    }
}

/// Columns of `views.csv`.
const VIEW_COLUMNS: [&str; 11] = [
    "scene",
    "target_frame",
    "variant",
    "num_storage_tokens",
    "num_render_tokens",
    "psnr",
    "ssim",
    "lpips_vgg",
    "render_s",
    "select_s",
    "tokens",
];

#[cfg(test)]
mod tests {
    use super::*;

    const CLIFT: Setting = Setting {
        variant: Variant::Clift,
        num_storage_tokens: 64,
        num_render_tokens: 32,
        tokens: Some(TokenStorage::F16),
    };

    #[test]
    fn views_csv_has_a_row_per_view_in_a_fixed_order_whatever_came_first() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("views.csv");
        let measured = Measured { render_s: Some(0.5), ..Measured::quality(20.25, Some(0.5)) };
        let rows = [
            ("room, \"big\"", 3, CLIFT, measured),
            ("attic", 9, CLIFT, measured),
            ("attic", 9, Setting::baseline(Variant::NearestView), Measured::quality(f64::INFINITY, None)),
        ];
        let expected =
            "scene,target_frame,variant,num_storage_tokens,num_render_tokens,psnr,ssim,lpips_vgg,render_s,select_s,tokens
attic,9,clift,64,32,20.25,0.5,,0.5,,f16
\"room, \"\"big\"\"\",3,clift,64,32,20.25,0.5,,0.5,,f16
attic,9,nearest_view,0,0,inf,,,,,
";
        for order in [[0, 1, 2], [2, 1, 0]] {
            let mut views = Accumulator::default();
            for (scene, frame, setting, view) in order.map(|i| rows[i]) {
                views.add(scene, frame, setting, view).unwrap();
            }
            views.write_views(&path).unwrap();
            assert_eq!(std::fs::read_to_string(&path).unwrap(), expected);
        }
    }

    #[test]
    fn a_view_counts_once() {
        let mut views = Accumulator::default();
        views.add("attic", 9, CLIFT, Measured::quality(20.0, None)).unwrap();
        let message = views.add("attic", 9, CLIFT, Measured::quality(30.0, None)).unwrap_err().to_string();
        assert_eq!(message, "clift of attic, frame 9, 64 stored, 32 rendered was already measured: a view counts once");
        assert_eq!(views.summary().points[0].psnr, Some(20.0));
    }

    #[test]
    fn a_variant_is_named_alike_in_json_and_csv() {
        for variant in [
            Variant::Clift,
            Variant::Kmeans,
            Variant::Patch,
            Variant::PatchClift,
            Variant::Random,
            Variant::NearestView,
            Variant::MeanImage,
        ] {
            assert_eq!(serde_json::to_value(variant).unwrap(), variant.name());
            assert_eq!(serde_json::from_value::<Variant>(variant.name().into()).unwrap(), variant);
        }
        let other = Variant::System(SystemName::new("MVSplat").unwrap());
        assert_eq!(serde_json::to_value(other).unwrap(), "MVSplat");
        assert_eq!(serde_json::from_value::<Variant>("MVSplat".into()).unwrap(), other);
        assert!(serde_json::from_value::<Variant>("".into()).is_err());
    }
}
