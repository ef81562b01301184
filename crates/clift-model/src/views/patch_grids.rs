//! Images averaged over shifted grids of patches ("cycle spinning", Coifman and Donoho 1995).
//!
//! The last layer makes the pixels of a patch from the token of that patch alone, which leaves seams between patches, and a
//! pattern inside them where a network knows little. An image that is rendered again with its patches elsewhere has both
//! elsewhere. With shifts along the diagonal every row and every column of a patch comes to lie on each other one: what repeats
//! along rows or columns of all patches cancels in the mean.
// B scenes, V views, H rows, W columns

use burn::tensor::{Tensor, TensorData};
use serde::{Deserialize, Serialize};

use crate::error::ModelError;
use crate::views::upload::Cameras;

const COUNTS: &str = "write 1, 2 or 4";

/// Number of patch grids that an image is the mean of.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "usize", into = "usize")]
pub enum PatchGrids {
    /// The image as drawn once (paper section 3.3).
    #[default]
    One,
    /// Two grids, half a patch apart along the diagonal.
    Two,
    /// Four grids, a quarter of a patch apart along the diagonal.
    Four,
}

impl From<PatchGrids> for usize {
    fn from(grids: PatchGrids) -> Self {
        match grids {
            PatchGrids::One => 1,
            PatchGrids::Two => 2,
            PatchGrids::Four => 4,
        }
    }
}

impl TryFrom<usize> for PatchGrids {
    type Error = ModelError;

    fn try_from(count: usize) -> Result<Self, ModelError> {
        let grids = [Self::One, Self::Two, Self::Four].into_iter().find(|&grids| usize::from(grids) == count);
        let bad = || ModelError::BadConfig { key: "patch_grids", value: count.to_string(), fix: COUNTS.into() };
        grids.ok_or_else(bad)
    }
}

impl std::str::FromStr for PatchGrids {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let count = text.parse::<usize>().ok().and_then(|count| Self::try_from(count).ok());
        count.ok_or_else(|| COUNTS.to_owned())
    }
}

impl PatchGrids {
    /// Returns the shift of every grid in pixels, both down and right; a patch of fewer pixels than grids has fewer shifts.
    fn shifts(self, patch_size: usize) -> Vec<usize> {
        let count = usize::from(self);
        let mut shifts: Vec<usize> = (0..count).map(|grid| grid * patch_size / count).collect();
        shifts.dedup();
        shifts
    }

    /// Returns the number of patches of every grid of an image, `[rows, columns]`: a shifted grid has one more of both.
    pub fn patches(self, patch_size: usize, patches: [usize; 2]) -> impl Iterator<Item = [usize; 2]> {
        let grown = move |shift: usize| patches.map(|side| side + usize::from(shift > 0));
        self.shifts(patch_size).into_iter().map(grown)
    }

    /// Returns the images that `draw` draws, on one of the grids, of which the first is `grid` 0.
    ///
    /// # Shapes
    /// - `draw`: of cameras of any size, `[batch, views, height, width, 3]`
    /// - returns `[batch, views, height, width, 3]` of the size of `targets`
    pub(crate) fn draw(
        self,
        patch_size: usize,
        targets: &Cameras,
        grid: usize,
        draw: impl Fn(&Cameras) -> Tensor<5>,
    ) -> Tensor<5> {
        let shift = self.shifts(patch_size)[grid];
        if shift == 0 {
            return draw(targets);
        }
        // The first patch begins `shift` pixels above and left of the image.
        let options = (&targets.intrinsics.device(), targets.intrinsics.dtype());
        let moved = TensorData::new(vec![0.0, 0.0, shift as f64, shift as f64], [1, 1, 4]);
        let cameras = Cameras {
            height: targets.height + patch_size,
            width: targets.width + patch_size,
            c2w: targets.c2w.clone(),
            intrinsics: targets.intrinsics.clone() + Tensor::<3>::from_data(moved, options),
        };
        draw(&cameras).narrow(2, shift, targets.height).narrow(3, shift, targets.width)
    }

    /// Returns the mean of the images that `draw` draws on every grid.
    ///
    /// # Shapes
    /// - as [`draw`](Self::draw)
    pub(crate) fn mean(self, patch_size: usize, targets: &Cameras, draw: impl Fn(&Cameras) -> Tensor<5>) -> Tensor<5> {
        let count = self.shifts(patch_size).len();
        let first = self.draw(patch_size, targets, 0, &draw);
        let sum = (1..count).fold(first, |sum, grid| sum + self.draw(patch_size, targets, grid, &draw));
        if count == 1 { sum } else { sum / count as f64 }
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;

    use super::*;
    use crate::testing::{assert_close, devices, random, to_vec};
    use crate::views::rays::plucker;

    fn cameras(device: &Device) -> Cameras {
        let c2w = Tensor::<2>::eye(4, device).reshape([1, 1, 4, 4]).expand([2, 3, 4, 4]);
        let intrinsics = random([2, 3, 4], 1, device).cast(c2w.dtype()).mul_scalar(0.3).add_scalar(9.0);
        Cameras { height: 12, width: 20, c2w, intrinsics }
    }

    #[test]
    fn every_pixel_is_drawn_with_its_own_ray() {
        for device in devices() {
            for (grids, patch_size) in
                [(PatchGrids::One, 4), (PatchGrids::Two, 4), (PatchGrids::Four, 4), (PatchGrids::Four, 1)]
            {
                let targets = cameras(&device);
                // Directions stand for colours: equal on every grid.
                let draw = |cameras: &Cameras| plucker(cameras).narrow(4, 3, 3);
                assert_close(&grids.mean(patch_size, &targets, draw), &draw(&targets), 2e-6);
            }
        }
    }

    #[test]
    fn patterns_along_rows_and_columns_cancel() {
        const LINE: [f32; 4] = [0.1, 0.9, 0.4, 0.2];
        let mean = f64::from(LINE.iter().sum::<f32>()) / 4.0;
        // Red values of an image whose pixels depend on row or column alone, as drawn on every grid.
        let red = |grids: PatchGrids, by_row: bool| {
            let draw = |cameras: &Cameras| {
                let [height, width] = [cameras.height, cameras.width];
                let value = |i: usize| LINE[if by_row { i / width } else { i % width } % 4];
                let pixels: Vec<f32> = (0..height * width).map(value).collect();
                let image = Tensor::<1>::from_floats(pixels.as_slice(), &Device::flex());
                image.reshape([1, 1, height, width, 1]).expand([2, 3, height, width, 3])
            };
            to_vec(grids.mean(4, &cameras(&Device::flex()), draw)).into_iter().step_by(3)
        };
        for by_row in [true, false] {
            assert!(red(PatchGrids::Four, by_row).all(|red| (red - mean).abs() < 1e-6));
            assert!(red(PatchGrids::One, by_row).any(|red| (red - mean).abs() > 0.1));
        }
    }

    #[test]
    fn counts_are_one_two_and_four() {
        let parse = |text: &str| serde_json::from_str::<PatchGrids>(text).map_err(|error| error.to_string());
        for (count, grids) in [(1, PatchGrids::One), (2, PatchGrids::Two), (4, PatchGrids::Four)] {
            assert_eq!((parse(&count.to_string()), usize::from(grids)), (Ok(grids), count));
            assert_eq!(count.to_string().parse(), Ok(grids));
        }
        assert!(parse("3").unwrap_err().contains("write 1, 2 or 4"), "{:?}", parse("3"));
        assert_eq!([4, 2, 1].map(|size| PatchGrids::Four.shifts(size)), [vec![0, 1, 2, 3], vec![0, 1], vec![0]]);
        assert!(PatchGrids::Two.patches(4, [3, 5]).eq([[3, 5], [4, 6]]));
    }
}
