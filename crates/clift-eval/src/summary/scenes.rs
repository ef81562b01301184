//! `scenes.csv`: the means of every scene.

use std::path::Path;

use clift_data::files::replace;

use super::{capped, mean};
use crate::EvalError;
use crate::measured::{Accumulator, Measured};

const COLUMNS: [&str; 9] =
    ["scene", "variant", "num_storage_tokens", "num_render_tokens", "tokens", "num_views", "psnr", "ssim", "lpips_vgg"];

impl Accumulator {
    /// Writes a row per scene and setting, baselines included: means over the scene's views. An empty field was not
    /// measured.
    ///
    /// # Errors
    /// [`EvalError::Io`] when the folder cannot be written.
    pub fn write_scenes(&self, path: &Path) -> Result<(), EvalError> {
        let failed =
            |source| EvalError::Io { action: "writing the means of the scenes", source, path: path.to_owned() };
        let mut csv = csv::Writer::from_writer(Vec::new());
        let mut write = |row: [&str; 9]| csv.write_record(row).map_err(|error| failed(error.into()));
        write(COLUMNS)?;
        for (setting, views) in &self.views {
            let (stored, rendered) = (setting.num_storage_tokens.to_string(), setting.num_render_tokens.to_string());
            let views: Vec<_> = views.iter().collect();
            for scene in views.chunk_by(|((a, _), _), ((b, _), _)| a == b) {
                let text = |value: fn(&Measured) -> Option<f64>| {
                    let values: Vec<f64> = scene.iter().filter_map(|(_, view)| value(view)).collect();
                    mean(&values).map(|mean| mean.to_string()).unwrap_or_default()
                };
                write([
                    &scene[0].0.0,
                    setting.variant.name(),
                    &stored,
                    &rendered,
                    setting.format_name(),
                    &scene.len().to_string(),
                    &text(|view| Some(capped(view.psnr))),
                    &text(|view| view.ssim),
                    &text(|view| view.lpips_vgg),
                ])?;
            }
        }
        let content = csv.into_inner().map_err(|error| failed(error.into_error()))?;
        replace(path, &content).map_err(failed)
    }
}

#[cfg(test)]
mod tests {
    use clift_model::TokenStorage;

    use super::*;
    use crate::measured::{Setting, Variant};

    #[test]
    fn every_scene_has_its_own_means() {
        let setting = Setting {
            variant: Variant::Kmeans,
            num_storage_tokens: 64,
            num_render_tokens: 32,
            tokens: Some(TokenStorage::F32),
        };
        let mut views = Accumulator::default();
        for (scene, frame, psnr, lpips_vgg) in
            [("a", 0, 20.0, Some(0.25)), ("a", 5, 23.0, Some(0.75)), ("b", 0, f64::INFINITY, None)]
        {
            views.add(scene, frame, setting, Measured { lpips_vgg, ..Measured::quality(psnr, Some(0.5)) }).unwrap();
        }
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scenes.csv");
        views.write_scenes(&path).unwrap();
        let expected = "scene,variant,num_storage_tokens,num_render_tokens,tokens,num_views,psnr,ssim,lpips_vgg
a,kmeans,64,32,f32,2,21.5,0.5,0.5
b,kmeans,64,32,f32,1,100,0.5,
";
        assert_eq!(std::fs::read_to_string(&path).unwrap(), expected);
    }
}
