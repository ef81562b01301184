//! What is shown of a scene: a contact sheet, and small pictures for the report.

use std::collections::BTreeSet;

use clift_data::Clip;
use clift_model::SceneClusters;

use crate::EvalError;
use crate::measured::{Setting, Variant};
use crate::picture::{Picture, error_map};
use crate::predictions::Scored;
use crate::rendered::ScoredViews;
use crate::sheet::{Cell, Row, sheet};
use crate::token_choice::SelectedTokens;
use crate::view_scorer::target_image;

/// Most rows of a sheet; more targets are thinned evenly.
const MAX_ROWS: usize = 6;

/// Longer side of an exhibit's pictures: a report holds dozens of them.
const MAX_SIDE_PX: usize = 128;

/// Both forms of what is shown of a scene.
#[derive(Clone, Debug)]
pub struct Shown {
    /// Up to six target views at full size.
    pub sheet: Picture,
    /// One target view, small.
    pub exhibit: Exhibit,
}

/// One scene in a report.
#[derive(Clone, Debug)]
pub struct Exhibit {
    /// Key of the scene.
    pub key: String,
    /// Rows and columns of patches of a view.
    pub grid: [usize; 2],
    /// Context views.
    pub context: Vec<Picture>,
    /// The frame each context view is.
    pub context_frames: Vec<usize>,
    /// The target view in the middle.
    pub target: Picture,
    /// Its frame.
    pub target_frame: usize,
    /// That view, drawn in every setting, baselines included; ordered by setting.
    pub drawings: Vec<Drawing>,
    /// Clusters of the context views' tokens, by rising count.
    pub clusters: Vec<SceneClusters>,
    /// The tokens that view is drawn from where they are chosen; ordered by setting.
    pub choices: Vec<Choice>,
}

/// The target view of an exhibit in one setting.
#[derive(Clone, Debug)]
pub struct Drawing {
    /// How it was drawn.
    pub setting: Setting,
    /// Its PSNR in dB.
    pub psnr: f64,
    /// What it looks like.
    pub picture: Picture,
}

/// Stored tokens, and those that a view is drawn from.
#[derive(Clone, Debug)]
pub struct Choice {
    /// How it was drawn.
    pub setting: Setting,
    /// Patches of the context views that the stored tokens stand on.
    pub stored: Vec<u32>,
    /// Those of them that were chosen.
    pub chosen: Vec<u32>,
}

/// What a sweep has of a scene.
#[derive(Default)]
pub(crate) struct Material {
    /// Every setting, baselines first.
    pub renderings: Vec<ScoredViews>,
    /// By storage count.
    pub clusters: Vec<SceneClusters>,
    /// The patches that stored tokens stand on, and what was chosen of them for every target.
    pub choices: Vec<(Setting, Vec<u32>, Vec<SelectedTokens>)>,
    /// Other systems' pictures.
    pub others: Vec<Scored>,
}

impl Shown {
    /// Makes sheet and exhibit; `rows` are the views whose pictures were kept.
    pub(crate) fn new(clip: &Clip, material: &Material, rows: &[usize], patch_size: usize) -> Result<Self, EvalError> {
        let sheet = scene_sheet(clip, &material.renderings, rows)?;
        Ok(Self { sheet, exhibit: Exhibit::new(clip, material, rows[rows.len() / 2], patch_size)? })
    }
}

impl Exhibit {
    fn new(clip: &Clip, material: &Material, view: usize, patch_size: usize) -> Result<Self, EvalError> {
        let (height, width) = (clip.target.height, clip.target.width);
        let context = clip.context.images.chunks(height * width * 3);
        let context = context.map(|rgb| Ok(small(Picture::from_rgb8(rgb, height, width)?)));
        let mut drawings = Vec::new();
        for rendered in &material.renderings {
            let picture = small(Picture::from_unit(&rendered.shown[&view], height, width)?);
            drawings.push(Drawing { setting: rendered.setting, psnr: rendered.measured[view].psnr, picture });
        }
        for scored in &material.others {
            if let (Some(pixels), Some(measured)) = (scored.shown.get(&view), scored.measured.get(&view)) {
                let picture = small(Picture::from_unit(pixels, height, width)?);
                drawings.push(Drawing { setting: scored.setting, psnr: measured.psnr, picture });
            }
        }
        drawings.sort_by_key(|drawing| drawing.setting);
        drawings.dedup_by_key(|drawing| drawing.setting);
        let choice = |(setting, stored, chosen): &(Setting, Vec<u32>, Vec<SelectedTokens>)| {
            let chosen = chosen[view].tokens.iter().map(|&token| stored[token as usize]).collect();
            Choice { setting: *setting, stored: stored.clone(), chosen }
        };
        let mut choices: Vec<Choice> = material.choices.iter().map(choice).collect();
        choices.sort_by_key(|choice| choice.setting);
        choices.dedup_by_key(|choice| choice.setting);
        let mut clusters = material.clusters.clone();
        clusters.sort_by_key(|clusters| clusters.centroid_index().len());
        clusters.dedup_by_key(|clusters| clusters.centroid_index().len());
        Ok(Self {
            key: clip.key.clone(),
            grid: [height / patch_size, width / patch_size],
            context: context.collect::<Result<_, EvalError>>()?,
            context_frames: clip.context.frame_index.clone(),
            target: small(Picture::from_unit(&target_image(&clip.target, view), height, width)?),
            target_frame: clip.target.frame_index[view],
            drawings,
            clusters,
            choices,
        })
    }
}

fn small(picture: Picture) -> Picture {
    let too_large = picture.width().max(picture.height()) > MAX_SIDE_PX;
    if too_large { picture.fitted(MAX_SIDE_PX, MAX_SIDE_PX) } else { picture }
}

/// The variant that stands for the method: the condensed one where there is a condenser.
pub(crate) fn best_variant(settings: impl IntoIterator<Item = Setting>) -> Option<Variant> {
    let there: BTreeSet<Variant> = settings.into_iter().map(|setting| setting.variant).collect();
    [Variant::Clift, Variant::PatchClift, Variant::Kmeans, Variant::Random]
        .into_iter()
        .find(|variant| there.contains(variant))
}

/// The views a sheet shows: all, or `MAX_ROWS` of them from the first to the last.
pub(crate) fn sheet_rows(num_views: usize) -> Vec<usize> {
    spread(num_views, MAX_ROWS)
}

/// All of `0..count`, or `most` of them from the first to the last; `most` is at least 2.
pub(crate) fn spread(count: usize, most: usize) -> Vec<usize> {
    if count <= most {
        return (0..count).collect();
    }
    (0..most).map(|i| i * (count - 1) / (most - 1)).collect()
}

/// Columns: contexts, target, nearest view, then the fewest and the most tokens of the best variant
/// there is, and the error of the last.
fn scene_sheet(clip: &Clip, renderings: &[ScoredViews], shown_views: &[usize]) -> Result<Picture, EvalError> {
    let best = best_variant(renderings.iter().map(|rendering| rendering.setting));
    let whole = |setting: Setting| setting.num_render_tokens == setting.num_storage_tokens;
    let shown = renderings.iter().filter(|r| Some(r.setting.variant) == best && whole(r.setting));
    let mut shown: Vec<&ScoredViews> = shown.collect();
    shown.sort_by_key(|r| r.setting.num_storage_tokens);
    shown.dedup_by_key(|r| r.setting.num_storage_tokens);
    if shown.len() > 2 {
        shown = vec![shown[0], shown[shown.len() - 1]];
    }
    let nearest = renderings.iter().find(|r| r.setting.variant == Variant::NearestView);

    let (height, width) = (clip.target.height, clip.target.width);
    let frame_len = height * width * 3;
    let contexts: Vec<Picture> = clip
        .context
        .images
        .chunks(frame_len)
        .map(|rgb| Picture::from_rgb8(rgb, height, width))
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
        let cell = |picture: Picture, caption: String| Cell { pictures: vec![picture], caption };
        let mut cells = vec![
            Cell { pictures: contexts.clone(), caption: String::new() },
            cell(Picture::from_unit(&truth, height, width)?, String::new()),
        ];
        for rendered in nearest.iter().chain(&shown) {
            let caption = format!("{:.2} dB", rendered.measured[view].psnr);
            cells.push(cell(Picture::from_unit(&rendered.shown[&view], height, width)?, caption));
        }
        if let Some(last) = shown.last() {
            cells.push(cell(error_map(&last.shown[&view], &truth, height, width)?, String::new()));
        }
        rows.push(Row { label: format!("frame {}", clip.target.frame_index[view]), cells });
    }
    Ok(sheet(&clip.key, &columns, &rows))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sheet_of_many_views_goes_from_the_first_to_the_last() {
        assert_eq!(sheet_rows(3), [0, 1, 2]);
        assert_eq!(sheet_rows(6), [0, 1, 2, 3, 4, 5]);
        let rows = sheet_rows(121);
        assert_eq!((rows.len(), rows[0], rows[MAX_ROWS - 1]), (MAX_ROWS, 0, 120));
    }

    #[test]
    fn the_condensed_variant_stands_for_the_method_where_it_is_there() {
        let settings = [Variant::NearestView, Variant::Random, Variant::Kmeans].map(Setting::baseline);
        assert_eq!(best_variant(settings), Some(Variant::Kmeans));
        assert_eq!(best_variant(settings.into_iter().chain([Setting::baseline(Variant::Clift)])), Some(Variant::Clift));
        assert_eq!(best_variant([Setting::baseline(Variant::MeanImage)]), None);
    }

    #[test]
    fn small_pictures_stay_as_they_are_and_large_ones_shrink() {
        let size = |height, width| {
            let picture = small(Picture::new(width, height, [7; 3]));
            (picture.height(), picture.width())
        };
        assert_eq!([size(32, 32), size(256, 512), size(512, 256)], [(32, 32), (64, 128), (128, 64)]);
    }
}
