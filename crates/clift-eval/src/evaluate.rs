//! The sweep: every scene encoded once, rendered with every variant at every token count.

use std::collections::BTreeMap;
use std::time::Instant;

use burn::tensor::{Device, Int, Tensor, TensorData};
use clift_data::order::{derive_seed, item_rng};
use clift_data::{Clip, Views as HostViews};
use clift_model::scene::file_bytes;
use clift_model::{Cameras, Clusters, Condenser, Encoder, KMeans, Renderer, TokenStorage};
use rand::seq::SliceRandom;

use crate::EvalError;
use crate::baseline::{mean_image, nearest_image};
use crate::measured::{Accumulator, Measured, Setting, Variant};
use crate::metrics::{SSIM_MIN_SIZE_PX, psnr, ssim};
use crate::picture::{Picture, error_map};
use crate::sheet::{Cell, Row, sheet};
use crate::token_count::TokenCount;
use crate::upload::{upload_cameras, upload_views};

/// Target views rendered at once: bounds memory for clips with a hundred targets.
const VIEWS_PER_PASS: usize = 8;

/// Most rows of a sheet; more targets are thinned evenly.
const MAX_ROWS: usize = 6;

/// The networks of an evaluation, on a device without autodiff.
#[derive(Clone, Debug)]
pub struct Networks {
    /// Encoder, the same for both stages.
    pub encoder: Encoder,
    /// Stage-1 renderer: draws random subsets and uncondensed centroids.
    pub renderer: Renderer,
    /// Condenser and stage-2 renderer, once there are.
    pub condensed: Option<(Condenser, Renderer)>,
    /// Where they live.
    pub device: Device,
}

/// Settings of a sweep.
#[derive(Clone, Debug)]
pub struct Sweep {
    /// Token counts a scene is stored with.
    pub storage: Vec<TokenCount>,
    /// Number format that the tokens of [`Variant::Clift`] and [`Variant::Kmeans`] are rounded to, as in a scene file.
    pub tokens: TokenStorage,
    /// Which variants are rendered; [`Variant::Clift`] needs [`Networks::condensed`].
    pub variants: Vec<Variant>,
    /// Latent K-means.
    pub kmeans: KMeans,
    /// Seed of K-means and of the random subsets; each scene derives its own from it and its key.
    pub seed: u64,
}

/// All targets of a scene in one setting.
struct Rendered {
    setting: Setting,
    measured: Vec<Measured>,
    /// The pictures a sheet shows, by view: `height * width * 3` values of RGB.
    shown: BTreeMap<usize, Vec<f32>>,
}

impl Rendered {
    fn new(setting: Setting) -> Self {
        Self { setting, measured: Vec::new(), shown: BTreeMap::new() }
    }

    /// Measures the next view, and keeps its picture if it is to be shown.
    fn add(&mut self, pixels: Vec<f32>, target: &HostViews, rows: &[usize]) -> Result<(), EvalError> {
        let view = self.measured.len();
        self.measured.push(measure(&pixels, target, view)?);
        if rows.contains(&view) {
            self.shown.insert(view, pixels);
        }
        Ok(())
    }
}

/// The views a sheet shows: all, or `MAX_ROWS` of them from the first to the last.
fn sheet_rows(num_views: usize) -> Vec<usize> {
    if num_views <= MAX_ROWS {
        return (0..num_views).collect();
    }
    (0..MAX_ROWS).map(|row| row * (num_views - 1) / (MAX_ROWS - 1)).collect()
}

/// Renders and measures the targets of one scene; returns a sheet of pictures when asked for.
///
/// Sampling per scene as in the paper: one random subset shared by all its targets.
///
/// # Errors
/// [`EvalError::BadTokenCount`] for a count the scene does not have, [`EvalError::NotFinite`] for a
/// rendering that is not finite, and whatever the model refuses.
pub fn evaluate_scene(
    networks: &Networks,
    clip: &Clip,
    sweep: &Sweep,
    with_sheet: bool,
    into: &mut Accumulator,
) -> Result<Option<Picture>, EvalError> {
    let device = &networks.device;
    let lift = networks.encoder.forward(&upload_views(&[&clip.context], device)?); // [1, N, D]
    let num_tokens = lift.dims()[1];
    let rows = if with_sheet { sheet_rows(clip.target.num_views()) } else { Vec::new() };
    let mut renderings = baselines(clip, &rows)?;
    for &count in &sweep.storage {
        let num_storage_tokens = count.of(num_tokens)?;
        let seed = derive_seed(sweep.seed, &clip.key);
        let index = KMeansOnce::new(&sweep.kmeans, &lift, num_storage_tokens, seed);
        for &variant in &sweep.variants {
            let (tokens, renderer) = match variant {
                Variant::Random => (random_subset(&lift, num_storage_tokens, seed), &networks.renderer),
                Variant::Kmeans => {
                    (index.clusters()?.upload(device).gather_centroids(lift.clone()), &networks.renderer)
                }
                Variant::Clift => {
                    let (condenser, renderer) = networks.condensed.as_ref().ok_or(EvalError::NoCondenser)?;
                    (condenser.forward(lift.clone(), &index.clusters()?.upload(device)), renderer)
                }
                Variant::Patch | Variant::NearestView | Variant::MeanImage => {
                    return Err(EvalError::NotRendered { variant: variant.name() });
                }
            };
            let setting = Setting { variant, num_storage_tokens, num_render_tokens: num_storage_tokens };
            let tokens = if variant == Variant::Random {
                tokens
            } else {
                let num_views = clip.context.num_views();
                into.add_scene_bytes(
                    setting,
                    file_bytes(num_storage_tokens, tokens.dims()[2], num_views, sweep.tokens),
                );
                rounded(tokens, sweep.tokens)?
            };
            renderings.push(render(renderer, tokens, &clip.target, setting, &rows)?);
        }
    }
    for rendering in &renderings {
        for (&frame, &measured) in clip.target.frame_index.iter().zip(&rendering.measured) {
            // A target drawn twice is one view.
            if !into.contains(&clip.key, frame, rendering.setting) {
                into.add(&clip.key, frame, rendering.setting, measured)?;
            }
        }
    }
    if with_sheet { Ok(Some(scene_sheet(clip, &renderings, &rows)?)) } else { Ok(None) }
}

/// K-means of one count, computed when the first variant asks.
struct KMeansOnce<'a> {
    kmeans: &'a KMeans,
    lift: &'a Tensor<3>,
    num_clusters: usize,
    seed: u64,
    clusters: std::cell::OnceCell<Clusters>,
}

impl<'a> KMeansOnce<'a> {
    fn new(kmeans: &'a KMeans, lift: &'a Tensor<3>, num_clusters: usize, seed: u64) -> Self {
        Self { kmeans, lift, num_clusters, seed, clusters: std::cell::OnceCell::new() }
    }

    fn clusters(&self) -> Result<&Clusters, EvalError> {
        if let Some(clusters) = self.clusters.get() {
            return Ok(clusters);
        }
        let fit = self.kmeans.fit(self.lift.clone(), self.num_clusters, &[self.seed])?;
        Ok(self.clusters.get_or_init(|| fit.clusters))
    }
}

/// `count` tokens of one scene without replacement, in order.
fn random_subset(lift: &Tensor<3>, count: usize, seed: u64) -> Tensor<3> {
    let mut index: Vec<i64> = (0..lift.dims()[1] as i64).collect();
    index.shuffle(&mut item_rng(seed, 0, 0, 0, "random subset"));
    index.truncate(count);
    index.sort_unstable();
    let index = Tensor::<1, Int>::from_data(TensorData::new(index, [count]), &lift.device());
    lift.clone().select(1, index)
}

/// Tokens `[1, S, D]` as they would come back from a scene file.
fn rounded(tokens: Tensor<3>, storage: TokenStorage) -> Result<Tensor<3>, EvalError> {
    if storage == TokenStorage::F32 {
        return Ok(tokens);
    }
    let (shape, device) = (tokens.dims(), tokens.device());
    let values: Vec<f32> = tokens.into_data().convert::<f32>().try_to_vec().map_err(EvalError::tensor)?;
    let values = storage.round(&values, shape[2])?;
    Ok(Tensor::from_data(TensorData::new(values, shape), &device))
}

fn render(
    renderer: &Renderer,
    tokens: Tensor<3>,
    target: &HostViews,
    setting: Setting,
    rows: &[usize],
) -> Result<Rendered, EvalError> {
    let mut rendered = Rendered::new(setting);
    let frame_len = target.height * target.width * 3;
    let device = tokens.device();
    let cameras = upload_cameras(&[target], &device)?;
    // So that the clock below does not count what is still queued.
    device.sync().map_err(EvalError::tensor)?;
    let started = Instant::now();
    let memory = renderer.memory(&tokens);
    device.sync().map_err(EvalError::tensor)?;
    // Once for the scene: every view bears its share.
    let shared_s = started.elapsed().as_secs_f64() / target.num_views() as f64;
    for start in (0..target.num_views()).step_by(VIEWS_PER_PASS) {
        let count = VIEWS_PER_PASS.min(target.num_views() - start);
        let cameras = Cameras {
            c2w: cameras.c2w.clone().narrow(1, start, count),
            intrinsics: cameras.intrinsics.clone().narrow(1, start, count),
            ..cameras
        };
        let started = Instant::now();
        let images = renderer.draw(&memory, &cameras); // [1, T, H, W, 3]
        let values: Vec<f32> = images.into_data().convert::<f32>().try_to_vec().map_err(EvalError::tensor)?;
        let render_s = shared_s + started.elapsed().as_secs_f64() / count as f64;
        for pixels in values.chunks(frame_len) {
            rendered.add(pixels.to_vec(), target, rows)?;
        }
        for measured in &mut rendered.measured[start..] {
            measured.render_s = Some(render_s);
        }
    }
    Ok(rendered)
}

fn baselines(clip: &Clip, rows: &[usize]) -> Result<Vec<Rendered>, EvalError> {
    let mean = mean_image(&clip.context)?;
    let mut nearest = Rendered::new(Setting::baseline(Variant::NearestView));
    let mut means = Rendered::new(Setting::baseline(Variant::MeanImage));
    for &pose in &clip.target.c2w {
        nearest.add(nearest_image(&clip.context, pose)?, &clip.target, rows)?;
        means.add(mean.clone(), &clip.target, rows)?;
    }
    Ok(vec![nearest, means])
}

/// Ground truth of one target in `[0, 1]`.
fn truth(target: &HostViews, view: usize) -> Vec<f32> {
    let len = target.height * target.width * 3;
    target.images[view * len..(view + 1) * len].iter().map(|&value| f32::from(value) / 255.0).collect()
}

fn measure(pixels: &[f32], target: &HostViews, view: usize) -> Result<Measured, EvalError> {
    let truth = truth(target, view);
    let (height, width) = (target.height, target.width);
    let large_enough = height.min(width) >= SSIM_MIN_SIZE_PX;
    let ssim = if large_enough { Some(ssim(pixels, &truth, height, width)?) } else { None };
    Ok(Measured::quality(psnr(pixels, &truth)?, ssim))
}

/// Columns: contexts, target, nearest view, then the fewest and the most tokens of the best variant
/// there is, and the error of the last.
fn scene_sheet(clip: &Clip, renderings: &[Rendered], shown_views: &[usize]) -> Result<Picture, EvalError> {
    let best = [Variant::Clift, Variant::Kmeans, Variant::Random];
    let best = best.into_iter().find(|variant| renderings.iter().any(|r| r.setting.variant == *variant));
    let mut shown: Vec<&Rendered> = renderings.iter().filter(|r| Some(r.setting.variant) == best).collect();
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
        let truth = truth(&clip.target, view);
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
    fn random_subsets_are_distinct_nested_and_of_the_seed() {
        let device = Device::flex();
        let lift = Tensor::<1, Int>::arange(0..50, &device).float().reshape([1, 50, 1]);
        let subset = |count, seed| random_subset(&lift, count, seed).into_data().try_to_vec::<f32>().expect("f32");
        let (few, more) = (subset(5, 1), subset(20, 1));
        assert!(few.iter().all(|token| more.contains(token)));
        assert!(more.windows(2).all(|pair| pair[0] < pair[1]));
        assert_ne!(subset(5, 1), subset(5, 2));
    }
}
