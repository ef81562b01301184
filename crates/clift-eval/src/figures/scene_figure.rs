//! The figures of one scene: a contact sheet at full size, and small images for the report.

use clift_core::ClipViews;
use clift_data::Clip;
use clift_model::SceneClusters;

use crate::config::method::Method;
use crate::error::EvalError;
use crate::figures::canvas::{Canvas, error_map};
use crate::figures::contact_sheet::{Cell, Row, contact_sheet};
use crate::statistics::view_metrics::{EvalKey, best_method};
use crate::sweep::rendered_views::{SceneResults, ScoredViews};
use clift_scene::view_image;

/// Longer side of an image in the report, which holds dozens of images.
const MAX_SIDE_PX: usize = 128;

/// Both figures of a scene.
#[derive(Clone, Debug)]
pub struct SceneFigures {
    /// Up to six target views at full size.
    pub contact_sheet: Canvas,
    /// One target view, small.
    pub figure: SceneFigure,
}

/// One scene in a report.
#[derive(Clone, Debug)]
pub struct SceneFigure {
    /// Key of the scene.
    pub scene: String,
    /// Rows and columns of patches of a view.
    pub grid: [usize; 2],
    /// Context images.
    pub context: Vec<Canvas>,
    /// Frames of the context images.
    pub context_frames: Vec<usize>,
    /// The target image in the middle of the kept target views.
    pub target: Canvas,
    /// Frame of the target image.
    pub target_frame: usize,
    /// Renderings of the target view, baselines and external methods included, ordered by key.
    pub images: Vec<FigureImage>,
    /// Clusters of the context tokens, by ascending number of clusters.
    pub clusters: Vec<SceneClusters>,
    /// Tokens that were selected for the target view, ordered by key.
    pub selections: Vec<FigureTokens>,
}

/// A rendering of the target view of a figure.
#[derive(Clone, Debug)]
pub struct FigureImage {
    /// Method and token counts.
    pub key: EvalKey,
    /// PSNR in dB.
    pub psnr: f64,
    /// The rendering.
    pub image: Canvas,
    /// The error map, of the main method and the nearest context view.
    pub error: Option<Canvas>,
}

/// The stored tokens of a scene, and the tokens selected for the target view.
#[derive(Clone, Debug)]
pub struct FigureTokens {
    /// Method and token counts.
    pub key: EvalKey,
    /// Context patches of the stored tokens.
    pub stored: Vec<u32>,
    /// Context patches of the selected tokens.
    pub selected: Vec<u32>,
}

impl SceneFigures {
    /// Makes both figures from the results of a scene with patches of `patch_size` pixels.
    ///
    /// # Errors
    /// [`EvalError::BadImage`] for results of another clip.
    pub fn new(clip: &Clip, results: &SceneResults, patch_size: usize) -> Result<Self, EvalError> {
        let views = &results.kept_views;
        let contact_sheet = scene_sheet(clip, &results.renderings, views)?;
        let figure = SceneFigure::new(clip, results, views[views.len() / 2], patch_size)?;
        Ok(Self { contact_sheet, figure })
    }
}

impl SceneFigure {
    fn new(clip: &Clip, results: &SceneResults, view: usize, patch_size: usize) -> Result<Self, EvalError> {
        let (height, width) = (clip.target.height, clip.target.width);
        let target = view_image(&clip.target, view);
        let best = best_method(results.renderings.iter().map(|rendering| rendering.key));
        let mut images = Vec::new();
        for rendering in &results.renderings {
            if let (Some(pixels), Some(metrics)) = (rendering.images.get(&view), rendering.metrics.get(&view)) {
                let image = small(Canvas::from_unit(pixels, height, width)?);
                let has_error = [best, Some(Method::NearestView)].contains(&Some(rendering.key.method));
                let error = has_error.then(|| error_map(pixels, &target, height, width).map(small)).transpose()?;
                images.push(FigureImage { key: rendering.key, psnr: metrics.psnr, image, error });
            }
        }
        images.sort_by_key(|image| image.key);
        images.dedup_by_key(|image| image.key);
        let selections = results.selections.iter().map(|(key, stored, selected)| {
            let selected = selected[view].tokens.iter().map(|&token| stored[token as usize]).collect();
            FigureTokens { key: *key, stored: stored.clone(), selected }
        });
        let mut selections: Vec<FigureTokens> = selections.collect();
        selections.sort_by_key(|selection| selection.key);
        selections.dedup_by_key(|selection| selection.key);
        let mut clusters = results.clusters.clone();
        clusters.sort_by_key(|clusters| clusters.centroid_index().len());
        clusters.dedup_by_key(|clusters| clusters.centroid_index().len());
        Ok(Self {
            scene: clip.key.clone(),
            grid: [height / patch_size, width / patch_size],
            context: canvases(&clip.context)?.into_iter().map(small).collect(),
            context_frames: clip.context.frame_index.clone(),
            target: small(Canvas::from_unit(&target, height, width)?),
            target_frame: clip.target.frame_index[view],
            images,
            clusters,
            selections,
        })
    }
}

fn canvases(views: &ClipViews) -> Result<Vec<Canvas>, EvalError> {
    let (height, width) = (views.height, views.width);
    views.images.chunks(height * width * 3).map(|rgb| Canvas::from_rgb8(rgb, height, width)).collect()
}

fn small(image: Canvas) -> Canvas {
    let too_large = image.width().max(image.height()) > MAX_SIDE_PX;
    if too_large { image.fitted(MAX_SIDE_PX, MAX_SIDE_PX) } else { image }
}

/// Makes the contact sheet. Columns: contexts, target, nearest view, the best method with its fewest and its most tokens,
/// and the error of the last rendering.
fn scene_sheet(clip: &Clip, renderings: &[ScoredViews], views: &[usize]) -> Result<Canvas, EvalError> {
    let best = best_method(renderings.iter().map(|rendering| rendering.key));
    let mut best: Vec<&ScoredViews> =
        renderings.iter().filter(|r| Some(r.key.method) == best && r.key.is_whole()).collect();
    best.sort_by_key(|r| r.key.num_storage_tokens);
    best.dedup_by_key(|r| r.key.num_storage_tokens);
    if best.len() > 2 {
        best = vec![best[0], best[best.len() - 1]];
    }
    let nearest = renderings.iter().find(|r| r.key.method == Method::NearestView);
    let (height, width) = (clip.target.height, clip.target.width);
    let contexts = canvases(&clip.context)?;
    let mut columns = vec!["contexts".to_owned(), "target".into(), "nearest view".into()];
    for rendering in &best {
        columns.push(format!("{}, {} tokens", rendering.key.method.name(), rendering.key.num_storage_tokens));
    }
    columns.push("error".into());
    let columns: Vec<&str> = columns.iter().map(String::as_str).collect();
    let mut rows = Vec::new();
    for &view in views {
        let target = view_image(&clip.target, view);
        let cell = |image: Canvas, caption: String| Cell { images: vec![image], caption };
        let mut cells = vec![
            Cell { images: contexts.clone(), caption: String::new() },
            cell(Canvas::from_unit(&target, height, width)?, String::new()),
        ];
        for rendering in nearest.iter().chain(&best) {
            let caption = format!("{:.2} dB", rendering.metrics[&view].psnr);
            cells.push(cell(Canvas::from_unit(&rendering.images[&view], height, width)?, caption));
        }
        if let Some(last) = best.last() {
            cells.push(cell(error_map(&last.images[&view], &target, height, width)?, String::new()));
        }
        rows.push(Row { label: format!("frame {}", clip.target.frame_index[view]), cells });
    }
    Ok(contact_sheet(&clip.key, &columns, &rows))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_large_images_shrink() {
        let size = |height, width| {
            let image = small(Canvas::new(width, height, [7; 3]));
            (image.height(), image.width())
        };
        assert_eq!([size(32, 32), size(256, 512), size(512, 256)], [(32, 32), (64, 128), (128, 64)]);
    }
}
