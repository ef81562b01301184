//! `views.csv` and `scenes.csv`: the metrics of every view, and their means per scene. An empty field was not measured.

use std::path::Path;

use clift_core::replace_file;
use clift_scene::TokenCoding;
use serde::{Deserialize, Serialize};

use crate::config::method::Method;
use crate::error::EvalError;
use crate::statistics::eval_results::EvalResults;
use crate::statistics::view_metrics::{EvalKey, METRICS, ViewMetrics, view_mean};

#[derive(Serialize, Deserialize)]
struct ViewRow {
    scene: String,
    target_frame: usize,
    method: Method,
    num_storage_tokens: usize,
    num_render_tokens: usize,
    psnr: f64,
    ssim: Option<f64>,
    lpips_vgg: Option<f64>,
    sharpness: Option<f64>,
    render_s: Option<f64>,
    select_s: Option<f64>,
    tokens: Option<TokenCoding>,
    /// Frame numbers, separated by spaces.
    context_frames: Option<String>,
}

#[derive(Serialize)]
struct SceneRow<'a> {
    scene: &'a str,
    method: Method,
    num_storage_tokens: usize,
    num_render_tokens: usize,
    tokens: Option<TokenCoding>,
    num_views: usize,
    psnr: Option<f64>,
    ssim: Option<f64>,
    lpips_vgg: Option<f64>,
    sharpness: Option<f64>,
    context_frames: Option<String>,
}

/// Writes `views.csv`: a row per key and view, baselines included. An identical image has the PSNR `inf`.
pub fn write_views(results: &EvalResults, path: &Path) -> Result<(), EvalError> {
    let rows = results.views().flat_map(|(key, scenes)| {
        let EvalKey { method, num_storage_tokens, num_render_tokens, tokens } = key;
        let views = scenes.iter().flat_map(|(scene, frames)| frames.iter().map(move |view| (scene, view)));
        views.map(move |(scene, (&target_frame, view))| {
            let ViewMetrics { psnr, ssim, lpips_vgg, sharpness, render_s, select_s } = *view;
            ViewRow {
                scene: scene.clone(),
                target_frame,
                method,
                num_storage_tokens,
                num_render_tokens,
                psnr,
                ssim,
                lpips_vgg,
                sharpness,
                render_s,
                select_s,
                tokens,
                context_frames: results.context_list(scene),
            }
        })
    });
    write(path, rows).map_err(EvalError::io("writing the metrics of the views", path))
}

pub fn read_views(path: &Path) -> Result<EvalResults, EvalError> {
    let bad = |error: csv::Error| EvalError::NotComparable { reason: error.to_string(), path: path.into() };
    let mut results = EvalResults::default();
    for row in csv::Reader::from_path(path).map_err(bad)?.deserialize() {
        let row: ViewRow = row.map_err(bad)?;
        let ViewRow { method, num_storage_tokens, num_render_tokens, tokens, .. } = row;
        let ViewRow { psnr, ssim, lpips_vgg, sharpness, render_s, select_s, .. } = row;
        let key = EvalKey { method, num_storage_tokens, num_render_tokens, tokens };
        let view = ViewMetrics { psnr, ssim, lpips_vgg, sharpness, render_s, select_s };
        if !results.add(&row.scene, row.target_frame, key, view) {
            let reason = format!("frame {} of scene {} has two rows of {}", row.target_frame, row.scene, method.name());
            return Err(EvalError::NotComparable { reason, path: path.into() });
        }
    }
    Ok(results)
}

/// Writes `scenes.csv`: a row per key and scene, baselines included, with means over the views of the scene and its context
/// frames.
pub fn write_scenes(results: &EvalResults, path: &Path) -> Result<(), EvalError> {
    let rows = results.views().flat_map(|(key, scenes)| {
        let EvalKey { method, num_storage_tokens, num_render_tokens, tokens } = key;
        scenes.iter().map(move |(scene, views)| {
            let [psnr, ssim, lpips_vgg, sharpness] = METRICS.map(|metric| view_mean(views, metric));
            SceneRow {
                scene,
                method,
                num_storage_tokens,
                num_render_tokens,
                tokens,
                num_views: views.len(),
                psnr,
                ssim,
                lpips_vgg,
                sharpness,
                context_frames: results.context_list(scene),
            }
        })
    });
    write(path, rows).map_err(EvalError::io("writing the means of the scenes", path))
}

fn write(path: &Path, rows: impl Iterator<Item = impl Serialize>) -> std::io::Result<()> {
    let mut csv = csv::Writer::from_writer(Vec::new());
    for row in rows {
        csv.serialize(row)?;
    }
    replace_file(path, &csv.into_inner().map_err(csv::IntoInnerError::into_error)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::CLIFT;

    #[test]
    fn rows_have_a_fixed_order() {
        let (sharpness, render_s) = (Some(0.875), Some(0.25));
        let measured =
            |psnr, lpips_vgg| ViewMetrics { lpips_vgg, sharpness, render_s, ..ViewMetrics::quality(psnr, Some(0.5)) };
        let rows = [
            ("room, \"big\"", 3, CLIFT, measured(f64::INFINITY, None)),
            ("attic", 9, CLIFT, measured(20.0, Some(0.25))),
            ("attic", 2, CLIFT, measured(23.0, Some(0.75))),
            ("attic", 9, EvalKey::baseline(Method::NearestView), ViewMetrics::quality(18.5, None)),
        ];
        let views = "\
scene,target_frame,method,num_storage_tokens,num_render_tokens,psnr,ssim,lpips_vgg,sharpness,render_s,select_s,tokens,context_frames
attic,2,clift,64,32,23.0,0.5,0.75,0.875,0.25,,f16,0 5 12
attic,9,clift,64,32,20.0,0.5,0.25,0.875,0.25,,f16,0 5 12
\"room, \"\"big\"\"\",3,clift,64,32,inf,0.5,,0.875,0.25,,f16,
attic,9,nearest_view,0,0,18.5,,,,,,,0 5 12
";
        let scenes = "\
scene,method,num_storage_tokens,num_render_tokens,tokens,num_views,psnr,ssim,lpips_vgg,sharpness,context_frames
attic,clift,64,32,f16,2,21.5,0.5,0.5,0.875,0 5 12
\"room, \"\"big\"\"\",clift,64,32,f16,1,100.0,0.5,,0.875,
attic,nearest_view,0,0,,1,18.5,,,,0 5 12
";
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.csv");
        for order in [[0, 1, 2, 3], [3, 2, 1, 0]] {
            let mut results = EvalResults::default();
            results.facts.context_frames.insert("attic".into(), vec![0, 5, 12]);
            for (scene, frame, key, view) in order.map(|i| rows[i]) {
                results.add(scene, frame, key, view);
            }
            write_views(&results, &path).unwrap();
            assert_eq!(std::fs::read_to_string(&path).unwrap(), views);
            write_scenes(&results, &path).unwrap();
            assert_eq!(std::fs::read_to_string(&path).unwrap(), scenes);
        }
        std::fs::write(&path, format!("{views}attic,2,clift,64,32,24.0,0.5,0.75,,0.25,,f16,\n")).unwrap();
        let message = read_views(&path).unwrap_err().to_string();
        assert!(message.contains("frame 2 of scene attic has two rows of clift"), "{message}");
    }
}
