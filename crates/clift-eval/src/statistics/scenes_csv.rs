//! `scenes.csv`: the means of every scene.

use std::path::Path;

use clift_data::{mean, replace_file};

use crate::error::EvalError;
use crate::statistics::eval_results::EvalResults;
use crate::statistics::scene_means::capped;
use crate::statistics::view_metrics::ViewMetrics;

const COLUMNS: [&str; 9] =
    ["scene", "variant", "num_storage_tokens", "num_render_tokens", "tokens", "num_views", "psnr", "ssim", "lpips_vgg"];

/// Writes a row per key and scene, baselines included: means over the views of the scene. An empty field was not
/// measured.
///
/// # Errors
/// [`EvalError::Io`] when the folder cannot be written.
pub fn write_scenes(results: &EvalResults, path: &Path) -> Result<(), EvalError> {
    let failed = |source| EvalError::Io { action: "writing the means of the scenes", source, path: path.to_owned() };
    let mut csv = csv::Writer::from_writer(Vec::new());
    let mut write = |row: [&str; 9]| csv.write_record(row).map_err(|error| failed(error.into()));
    write(COLUMNS)?;
    for (key, scenes) in results.views() {
        let (stored, rendered) = (key.num_storage_tokens.to_string(), key.num_render_tokens.to_string());
        for (scene, views) in scenes {
            let text = |value: fn(&ViewMetrics) -> Option<f64>| {
                let values: Vec<f64> = views.values().filter_map(value).collect();
                mean(&values).map(|mean| mean.to_string()).unwrap_or_default()
            };
            write([
                scene,
                key.variant.name(),
                &stored,
                &rendered,
                key.format_name(),
                &views.len().to_string(),
                &text(|view| Some(capped(view.psnr))),
                &text(|view| view.ssim),
                &text(|view| view.lpips_vgg),
            ])?;
        }
    }
    let content = csv.into_inner().map_err(|error| failed(error.into_error()))?;
    replace_file(path, &content).map_err(failed)
}

#[cfg(test)]
mod tests {
    use clift_model::TokenFormat;

    use super::*;
    use crate::config::method::Method;
    use crate::statistics::view_metrics::EvalKey;

    #[test]
    fn every_scene_has_its_own_means() {
        let key = EvalKey {
            variant: Method::Kmeans,
            num_storage_tokens: 64,
            num_render_tokens: 32,
            tokens: Some(TokenFormat::F32),
        };
        let mut views = EvalResults::default();
        for (scene, frame, psnr, lpips_vgg) in
            [("a", 0, 20.0, Some(0.25)), ("a", 5, 23.0, Some(0.75)), ("b", 0, f64::INFINITY, None)]
        {
            views.add(scene, frame, key, ViewMetrics { lpips_vgg, ..ViewMetrics::quality(psnr, Some(0.5)) }).unwrap();
        }
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scenes.csv");
        write_scenes(&views, &path).unwrap();
        let expected = "scene,variant,num_storage_tokens,num_render_tokens,tokens,num_views,psnr,ssim,lpips_vgg
a,kmeans,64,32,f32,2,21.5,0.5,0.5
b,kmeans,64,32,f32,1,100,0.5,
";
        assert_eq!(std::fs::read_to_string(&path).unwrap(), expected);
    }
}
