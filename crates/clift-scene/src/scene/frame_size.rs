//! Frames of any size and field of view from a network that draws one.
//!
//! A network draws well what it was trained on: images of one number of patches, at the angle per pixel of the context views.
//! A network with camera-relative attention sees no focal length: at another angle per pixel it draws another zoom. A frame
//! is therefore resampled from an image at the pixel density of the context views. That image consists of windows of the
//! trained size, each with a principal point of its own: the middle window, and around it as many as a wide frame needs.

use clift_core::{Camera, Intrinsics, mean_intrinsics};
use clift_model::ModelError;
use fast_image_resize::images::{TypedImage, TypedImageRef};
use fast_image_resize::pixels::F32x3;
use fast_image_resize::{FilterType, ResizeAlg, ResizeOptions, Resizer};

use crate::scene::scene::Scene;

/// Relative difference of a focal length from the mean of the context views up to which the network draws with it: the
/// cameras of one lens differ by as much.
const SAME_LENS: f64 = 0.02;
/// Relative difference of the scales along rows and columns up to which they are one scale.
const SAME_SCALE: f64 = 1e-3;
/// Share of the trained image that a frame may reach beyond it on either side without further windows: the pixels at the
/// edge are repeated.
const REPEATED: f64 = 0.01;
const MAX_WINDOWS: usize = 64;
/// Pixels or patches that a rounding error may add to the field of view.
const ROUNDING: f64 = 1e-6;

#[derive(Clone, Copy, Debug)]
pub(crate) struct TrainedImage {
    pub size: [usize; 2],
    /// Focal lengths along rows and columns in pixels, `[fy, fx]`.
    focal: [f64; 2],
    patch_size: usize,
}

impl TrainedImage {
    /// Returns the size of the context views of a scene, and the mean focal lengths of those of a group.
    pub fn new(scene: &Scene, context: &[Camera]) -> Self {
        let focal = mean_intrinsics(context).map_or([1.0; 2], |mean| [mean.fy, mean.fx]);
        Self { size: [scene.height, scene.width], focal, patch_size: scene.model.patch_size }
    }

    pub fn patches(&self) -> [usize; 2] {
        self.size.map(|side| side / self.patch_size)
    }
}

/// Checks that a scene can be rendered at `[height, width]` pixels from all views.
pub fn check_frames(scene: &Scene, views: &[Camera], size: [usize; 2]) -> Result<(), ModelError> {
    let trained = TrainedImage::new(scene, &scene.context);
    views.iter().try_for_each(|view| FramePlan::new(trained, view, size).map(|_| ()))
}

/// The windows that a frame is drawn from, and their place under it.
#[derive(Debug)]
pub(crate) struct FramePlan {
    trained: TrainedImage,
    view: Camera,
    rows: Axis,
    columns: Axis,
}

impl FramePlan {
    pub fn new(trained: TrainedImage, view: &Camera, [height, width]: [usize; 2]) -> Result<Self, ModelError> {
        let intrinsics = view.intrinsics.to_array();
        if let Some(position) = intrinsics.iter().position(|value| !value.is_finite()) {
            let value = intrinsics[position] as f32;
            return Err(ModelError::NotFinite { name: "the target's intrinsics", value, position });
        }
        let Intrinsics { fx, fy, .. } = view.intrinsics;
        let bad = |fix| ModelError::BadConfig { key: "frame", value: format!("{width} x {height} pixels"), fix };
        if fx.min(fy) <= 0.0 {
            return Err(bad(format!("focal lengths are {fx} and {fy} pixels: write positive numbers")));
        }
        let sides = [height, width];
        // Field of view of the frame over that of the trained image.
        let mut ratios = [(0, fy), (1, fx)]
            .map(|(axis, focal)| sides[axis] as f64 * trained.focal[axis] / focal / trained.size[axis] as f64);
        let is_equal = |a: f64, b: f64, tolerance: f64| (a / b - 1.0).abs() <= tolerance;
        if is_equal(ratios[0], 1.0, SAME_LENS) && is_equal(ratios[1], ratios[0], SAME_SCALE) {
            ratios = [1.0; 2];
        }
        let axis = |axis: usize| Axis::new(sides[axis], ratios[axis], trained.size[axis], trained.patch_size);
        let axes = axis(0).zip(axis(1));
        match axes.filter(|(rows, columns)| rows.windows.len() * columns.windows.len() <= MAX_WINDOWS) {
            Some((rows, columns)) => Ok(Self { trained, view: *view, rows, columns }),
            None => Err(bad(format!(
                "the field of view takes more than {MAX_WINDOWS} images of the trained size: choose proportions nearer to \
                 a square, or a longer focal length"
            ))),
        }
    }

    /// Returns the cameras of the windows, images of the trained size, row by row.
    pub fn windows(&self) -> Vec<Camera> {
        let rows = self.rows.windows.iter();
        rows.flat_map(|&row| self.columns.windows.iter().map(move |&column| self.camera([row, column]))).collect()
    }

    /// Returns the camera of all windows together, and their `[height, width]`.
    pub fn whole(&self) -> (Camera, [usize; 2]) {
        let first = [&self.rows, &self.columns].map(|axis| axis.windows[0]);
        (self.camera(first), self.size())
    }

    fn size(&self) -> [usize; 2] {
        [(&self.rows, 0), (&self.columns, 1)].map(|(axis, i)| self.trained.size[i] + 2 * axis.beyond())
    }

    fn camera(&self, [row, column]: [i64; 2]) -> Camera {
        let Intrinsics { fx, fy, cx, cy } = self.view.intrinsics;
        let (x, y) = (&self.columns, &self.rows);
        let place = |axis: &Axis, centre: f64, first: i64| axis.start + centre * axis.scale - first as f64;
        let intrinsics =
            Intrinsics { fx: fx * x.scale, fy: fy * y.scale, cx: place(x, cx, column), cy: place(y, cy, row) };
        Camera { intrinsics, ..self.view }
    }

    /// Puts the windows together, of which the middle one covers its neighbours, and resamples them to the pixels of the frame,
    /// by bicubic convolution with antialiasing.
    ///
    /// # Shapes
    /// - `windows`: `[windows, height, width, 3]` in the order of [`windows`](Self::windows)
    /// - returns `[frame height, frame width, 3]`
    pub fn assemble(&self, windows: &[f32]) -> Vec<f32> {
        let ([height, width], [trained_height, trained_width]) = (self.size(), self.trained.size);
        // With the edges repeated.
        let [down, across] = [self.rows.repeated(), self.columns.repeated()];
        let inside = |place: usize, repeated: usize, side: usize| place.saturating_sub(repeated).min(side - 1);
        let places = windows.as_chunks::<3>().0;
        let row = |y: usize| {
            let (row, y) = self.rows.window_at(inside(y, down, height), trained_height);
            let columns = (0..width + 2 * across).map(move |x| {
                let (column, x) = self.columns.window_at(inside(x, across, width), trained_width);
                let window = row * self.columns.windows.len() + column;
                F32x3::new(places[(window * trained_height + y) * trained_width + x])
            });
            columns.collect::<Vec<_>>()
        };
        let pixels: Vec<F32x3> = (0..height + 2 * down).flat_map(row).collect();
        let [height, width] = [height + 2 * down, width + 2 * across];
        let image = TypedImageRef::new(width as u32, height as u32, &pixels).expect("a pixel per place");
        let mut frame = TypedImage::<F32x3>::new(self.columns.side as u32, self.rows.side as u32);
        let ([left, wide], [top, high]) = (self.columns.cut(width), self.rows.cut(height));
        let cubic = ResizeAlg::Convolution(FilterType::CatmullRom);
        let options = ResizeOptions::new().resize_alg(cubic).crop(left, top, wide, high);
        Resizer::new().resize_typed(&image, &mut frame, &options).expect("the frame lies in the image");
        frame.pixels().iter().flat_map(|pixel| pixel.0).map(|value| value.clamp(0.0, 1.0)).collect()
    }
}

/// One axis of a frame. Places count in pixels of the network from the beginning of the middle window.
#[derive(Clone, Debug, PartialEq)]
struct Axis {
    side: usize,
    /// Pixels of the network per pixel of the frame.
    scale: f64,
    /// Place where the frame begins, and its length.
    start: f64,
    length: f64,
    /// Beginnings of the windows, ascending, as many before 0 as after. All lie whole patches from 0.
    windows: Vec<i64>,
}

impl Axis {
    /// Covers `ratio` times the trained image, around its middle; `None` for too many windows.
    fn new(side: usize, ratio: f64, trained: usize, patch_size: usize) -> Option<Self> {
        let whole = trained as f64;
        let length = ratio * whole;
        let start = (whole - length) / 2.0;
        let patches = if -start <= REPEATED * whole { 0.0 } else { (-start / patch_size as f64 - ROUNDING).ceil() };
        let beyond = patches * patch_size as f64;
        if beyond > whole * MAX_WINDOWS as f64 {
            return None;
        }
        let (beyond, step) = (beyond as i64, trained as i64);
        let count = (beyond as usize).div_ceil(trained) as i64;
        let windows = (-count..=count).map(|window| (window * step).clamp(-beyond, beyond)).collect();
        Some(Self { side, scale: length / side as f64, start, length, windows })
    }

    /// Returns the pixels of the windows beyond the middle one, on either side.
    fn beyond(&self) -> usize {
        self.windows[0].unsigned_abs() as usize
    }

    /// Returns the number of pixels to repeat at either edge of an image of all windows.
    fn repeated(&self) -> usize {
        (-self.start - self.beyond() as f64 - ROUNDING).ceil().max(0.0) as usize
    }

    /// Returns the beginning and the length of the frame in an image of all windows and repeated edges, of `size` pixels.
    fn cut(&self, size: usize) -> [f64; 2] {
        let first = (self.start + (self.beyond() + self.repeated()) as f64).max(0.0);
        [first, self.length.min(size as f64 - first)]
    }

    /// Returns the window that shows a pixel of the image of all windows, and its pixel.
    fn window_at(&self, pixel: usize, trained: usize) -> (usize, usize) {
        let place = pixel as i64 - self.beyond() as i64;
        let window = (place.div_euclid(trained as i64) + self.windows.len() as i64 / 2) as usize;
        (window, (place - self.windows[window]) as usize)
    }
}

#[cfg(test)]
mod tests {
    use clift_core::Pose;
    use glam::DVec3;

    use super::*;

    const TRAINED: TrainedImage = TrainedImage { size: [16, 24], focal: [21.0, 20.0], patch_size: 8 };

    fn view() -> Camera {
        Camera { c2w: Pose::IDENTITY, intrinsics: Intrinsics { fx: 20.0, fy: 21.0, cx: 12.5, cy: 7.75 } }
    }

    fn plan([height, width]: [usize; 2]) -> Result<FramePlan, ModelError> {
        FramePlan::new(TRAINED, &view().resized(TRAINED.size, [height, width]), [height, width])
    }

    /// A picture of the directions of all pixels, smooth, in (0, 1).
    fn directions(camera: &Camera, [height, width]: [usize; 2]) -> Vec<f32> {
        let color = |d: DVec3| [0.5 + 0.3 * d.x, 0.5 + 0.3 * d.y, 0.5 + 0.2 * (6.0 * d.x).sin()];
        (0..height * width)
            .flat_map(|i| color(camera.direction((i % width) as f64 + 0.5, (i / width) as f64 + 0.5)))
            .map(|value| value as f32)
            .collect()
    }

    #[test]
    fn windows_cover_the_frame_around_the_trained_image() {
        for (size, rows, columns) in [
            ([16, 24], vec![0], vec![0]),
            ([8, 12], vec![0], vec![0]),
            ([37, 56], vec![0], vec![0]), // a tenth of a pixel beyond on either side: repeated
            ([16, 10], vec![0], vec![0]), // narrower: cut from the trained image
            ([16, 26], vec![0], vec![-8, 0, 8]), // one pixel on either side: a patch
            ([32, 96], vec![0], vec![-16, 0, 16]), // 48 pixels: 12 on either side
            ([16, 120], vec![0], vec![-48, -24, 0, 24, 48]),
        ] {
            let plan = plan(size).unwrap();
            assert_eq!((plan.rows.windows.clone(), plan.columns.windows.clone()), (rows, columns), "{size:?}");
            assert_eq!(plan.windows().len(), plan.rows.windows.len() * plan.columns.windows.len());
        }
        // A tenth of the focal length: ten times the field of view along both axes.
        let wide = Intrinsics { fx: 10.0, fy: 10.5, cx: 12.0, cy: 8.0 };
        let wide = FramePlan::new(TRAINED, &Camera { intrinsics: wide, ..view() }, [16, 24]).unwrap();
        assert_eq!((wide.rows.windows, wide.columns.windows), (vec![-8, 0, 8], vec![-16, 0, 16]));
        // A frame of the trained size is the drawn image.
        let plan = plan([16, 24]).unwrap();
        assert_eq!(plan.windows(), [view()]);
        assert_eq!(plan.whole(), (view(), [16, 24]));
        let image: Vec<f32> = (0..16 * 24 * 3).map(|i| (i * 37 % 101) as f32 / 101.0).collect();
        assert_eq!(plan.assemble(&image), image);
    }

    #[test]
    fn every_pixel_of_a_frame_of_any_size_shows_its_own_direction() {
        let off_centre = Intrinsics { fx: 31.0, fy: 14.0, cx: 40.0, cy: 3.0 };
        let sizes = [[16, 24], [24, 36], [37, 50], [12, 18], [16, 10], [61, 24], [64, 250], [32, 144]];
        let plans = sizes.map(|size| plan(size).unwrap()).into_iter();
        let other = FramePlan::new(TRAINED, &Camera { intrinsics: off_centre, ..view() }, [40, 56]).unwrap();
        for plan in plans.chain([other]) {
            let size = [plan.rows.side, plan.columns.side];
            let windows: Vec<f32> = plan.windows().iter().flat_map(|camera| directions(camera, TRAINED.size)).collect();
            let (frame, expected) = (plan.assemble(&windows), directions(&plan.view, size));
            assert_eq!(frame.len(), expected.len());
            for (i, (got, expected)) in frame.iter().zip(&expected).enumerate() {
                let [row, column] = [i / 3 / size[1], i / 3 % size[1]];
                // At the edge of the image bicubic convolution lacks neighbours.
                let is_edge = [(row, size[0]), (column, size[1])].iter().any(|&(at, side)| at.min(side - 1 - at) < 6);
                let tolerance = if is_edge { 0.02 } else { 0.004 };
                assert!(
                    (got - expected).abs() < tolerance,
                    "{size:?}, pixel {row}, {column}: {got}, expected {expected}"
                );
            }
        }
    }

    #[test]
    fn what_cannot_be_drawn_is_refused() {
        let with = |fx: f64, cy: f64| Camera { intrinsics: Intrinsics { fx, fy: 21.0, cx: 12.0, cy }, ..view() };
        let error = |fx: f64, cy: f64| FramePlan::new(TRAINED, &with(fx, cy), [16, 24]).unwrap_err().to_string();
        assert!(error(1e-3, 8.0).contains("`frame` = 24 x 16 pixels: the field of view takes more than 64 images"));
        assert!(error(-1.0, 8.0).contains("focal lengths are -1 and 21 pixels"));
        assert!(error(f64::NAN, 8.0).contains("the target's intrinsics holds NaN"));
        assert!(plan([16, 4000]).is_err());
    }
}
