//! What is shown of a scene: a contact sheet, and small pictures for the report.

use clift_data::Clip;
use clift_model::SceneClusters;

use crate::config::method::Method;
use crate::error::EvalError;
use crate::figures::canvas::{Canvas, error_map};
use crate::figures::contact_sheet::{Cell, Row, contact_sheet};
use crate::statistics::view_metrics::{EvalKey, best_variant};
use crate::sweep::rendered_views::ScoredViews;
use crate::sweep::scene_results::SceneResults;
use crate::sweep::token_choice::SelectedTokens;
use crate::sweep::view_scorer::target_image;

/// Longer side of an exhibit's pictures: a report holds dozens of them.
const MAX_SIDE_PX: usize = 128;

/// Both forms of what is shown of a scene.
#[derive(Clone, Debug)]
pub struct SceneFigures {
    /// Up to six target views at full size.
    pub sheet: Canvas,
    /// One target view, small.
    pub exhibit: SceneFigure,
}

/// One scene in a report.
#[derive(Clone, Debug)]
pub struct SceneFigure {
    /// Key of the scene.
    pub key: String,
    /// Rows and columns of patches of a view.
    pub grid: [usize; 2],
    /// Context views.
    pub context: Vec<Canvas>,
    /// The frame each context view is.
    pub context_frames: Vec<usize>,
    /// The target view in the middle.
    pub target: Canvas,
    /// Its frame.
    pub target_frame: usize,
    /// That view, drawn in every setting, baselines included; ordered by setting.
    pub drawings: Vec<Drawing>,
    /// Clusters of the context views' tokens, by rising count.
    pub clusters: Vec<SceneClusters>,
    /// The tokens that view is drawn from where they are chosen; ordered by setting.
    pub choices: Vec<FigureTokens>,
}

/// The target view of an exhibit in one setting.
#[derive(Clone, Debug)]
pub struct Drawing {
    /// How it was drawn.
    pub setting: EvalKey,
    /// Its PSNR in dB.
    pub psnr: f64,
    /// What it looks like.
    pub picture: Canvas,
}

/// Stored tokens, and those that a view is drawn from.
#[derive(Clone, Debug)]
pub struct FigureTokens {
    /// How it was drawn.
    pub setting: EvalKey,
    /// Patches of the context views that the stored tokens stand on.
    pub stored: Vec<u32>,
    /// Those of them that were chosen.
    pub chosen: Vec<u32>,
}

impl SceneFigures {
    /// Makes sheet and exhibit of the results of a scene, whose patches have `patch_size` pixels.
    ///
    /// # Errors
    /// [`EvalError::SizeMismatch`] for results of another clip.
    pub fn new(clip: &Clip, results: &SceneResults, patch_size: usize) -> Result<Self, EvalError> {
        let rows = &results.rows;
        let sheet = scene_sheet(clip, &results.renderings, rows)?;
        Ok(Self { sheet, exhibit: SceneFigure::new(clip, results, rows[rows.len() / 2], patch_size)? })
    }
}

impl SceneFigure {
    fn new(clip: &Clip, results: &SceneResults, view: usize, patch_size: usize) -> Result<Self, EvalError> {
        let (height, width) = (clip.target.height, clip.target.width);
        let context = clip.context.images.chunks(height * width * 3);
        let context = context.map(|rgb| Ok(small(Canvas::from_rgb8(rgb, height, width)?)));
        let mut drawings = Vec::new();
        for rendered in &results.renderings {
            let picture = small(Canvas::from_unit(&rendered.shown[&view], height, width)?);
            drawings.push(Drawing { setting: rendered.setting, psnr: rendered.measured[view].psnr, picture });
        }
        for scored in &results.others {
            if let (Some(pixels), Some(measured)) = (scored.shown.get(&view), scored.measured.get(&view)) {
                let picture = small(Canvas::from_unit(pixels, height, width)?);
                drawings.push(Drawing { setting: scored.setting, psnr: measured.psnr, picture });
            }
        }
        drawings.sort_by_key(|drawing| drawing.setting);
        drawings.dedup_by_key(|drawing| drawing.setting);
        let choice = |(setting, stored, chosen): &(EvalKey, Vec<u32>, Vec<SelectedTokens>)| {
            let chosen = chosen[view].tokens.iter().map(|&token| stored[token as usize]).collect();
            FigureTokens { setting: *setting, stored: stored.clone(), chosen }
        };
        let mut choices: Vec<FigureTokens> = results.choices.iter().map(choice).collect();
        choices.sort_by_key(|choice| choice.setting);
        choices.dedup_by_key(|choice| choice.setting);
        let mut clusters = results.clusters.clone();
        clusters.sort_by_key(|clusters| clusters.centroid_index().len());
        clusters.dedup_by_key(|clusters| clusters.centroid_index().len());
        Ok(Self {
            key: clip.key.clone(),
            grid: [height / patch_size, width / patch_size],
            context: context.collect::<Result<_, EvalError>>()?,
            context_frames: clip.context.frame_index.clone(),
            target: small(Canvas::from_unit(&target_image(&clip.target, view), height, width)?),
            target_frame: clip.target.frame_index[view],
            drawings,
            clusters,
            choices,
        })
    }
}

fn small(picture: Canvas) -> Canvas {
    let too_large = picture.width().max(picture.height()) > MAX_SIDE_PX;
    if too_large { picture.fitted(MAX_SIDE_PX, MAX_SIDE_PX) } else { picture }
}

/// Columns: contexts, target, nearest view, then the fewest and the most tokens of the best variant
/// there is, and the error of the last.
fn scene_sheet(clip: &Clip, renderings: &[ScoredViews], shown_views: &[usize]) -> Result<Canvas, EvalError> {
    let best = best_variant(renderings.iter().map(|rendering| rendering.setting));
    let shown = renderings.iter().filter(|r| Some(r.setting.variant) == best && r.setting.is_whole());
    let mut shown: Vec<&ScoredViews> = shown.collect();
    shown.sort_by_key(|r| r.setting.num_storage_tokens);
    shown.dedup_by_key(|r| r.setting.num_storage_tokens);
    if shown.len() > 2 {
        shown = vec![shown[0], shown[shown.len() - 1]];
    }
    let nearest = renderings.iter().find(|r| r.setting.variant == Method::NearestView);

    let (height, width) = (clip.target.height, clip.target.width);
    let frame_len = height * width * 3;
    let contexts: Vec<Canvas> = clip
        .context
        .images
        .chunks(frame_len)
        .map(|rgb| Canvas::from_rgb8(rgb, height, width))
        .collect::<Result<_, _>>()?;
    let mut columns = vec!["contexts".to_owned(), "target".into(), "nearest view".into()];
    for rendered in &shown {
        columns.push(format!("{}, {} tokens", rendered.setting.variant.name(), rendered.setting.num_storage_tokens));
    }
    columns.push("error".into());
    let columns: Vec<&str> = columns.iter().map(String::as_str).collect();

    let mut rows = Vec::new();
    for &view in shown_views {
        let truth = target_image(&clip.target, view);
        let cell = |picture: Canvas, caption: String| Cell { pictures: vec![picture], caption };
        let mut cells = vec![
            Cell { pictures: contexts.clone(), caption: String::new() },
            cell(Canvas::from_unit(&truth, height, width)?, String::new()),
        ];
        for rendered in nearest.iter().chain(&shown) {
            let caption = format!("{:.2} dB", rendered.measured[view].psnr);
            cells.push(cell(Canvas::from_unit(&rendered.shown[&view], height, width)?, caption));
        }
        if let Some(last) = shown.last() {
            cells.push(cell(error_map(&last.shown[&view], &truth, height, width)?, String::new()));
        }
        rows.push(Row { label: format!("frame {}", clip.target.frame_index[view]), cells });
    }
    Ok(contact_sheet(&clip.key, &columns, &rows))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_pictures_stay_as_they_are_and_large_ones_shrink() {
        let size = |height, width| {
            let picture = small(Canvas::new(width, height, [7; 3]));
            (picture.height(), picture.width())
        };
        assert_eq!([size(32, 32), size(256, 512), size(512, 256)], [(32, 32), (64, 128), (128, 64)]);
    }
}
