//! Images averaged over shifted grids of patches ("cycle spinning", Coifman and Donoho 1995).
//!
//! The last layer makes the pixels of a patch from the token of that patch alone, which leaves seams between patches. An image
//! that is rendered again with its patches elsewhere has its seams elsewhere. In the mean, weighted by the distance from the
//! seams, they are faint.
// B scenes, V views, H rows, W columns

use burn::tensor::{Tensor, TensorData};
use serde::{Deserialize, Serialize};

use crate::error::ModelError;
use crate::views::upload::Cameras;

/// Number of patch grids that an image is the mean of.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "usize", into = "usize")]
pub enum PatchGrids {
    /// The image as drawn once (paper section 3.3).
    #[default]
    One,
    /// Two grids, half a patch apart along the diagonal.
    Two,
    /// Four grids, shifted by half a patch along rows, columns and both.
    Four,
}

impl From<PatchGrids> for usize {
    fn from(grids: PatchGrids) -> Self {
        grids.half_shifts().len()
    }
}

impl TryFrom<usize> for PatchGrids {
    type Error = ModelError;

    fn try_from(count: usize) -> Result<Self, ModelError> {
        let grids = [Self::One, Self::Two, Self::Four].into_iter().find(|&grids| usize::from(grids) == count);
        let fix = "write 1, 2 or 4".to_owned();
        grids.ok_or_else(|| ModelError::BadConfig { key: "patch_grids", value: count.to_string(), fix })
    }
}

impl std::str::FromStr for PatchGrids {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let count = text.parse::<usize>().ok().and_then(|count| Self::try_from(count).ok());
        count.ok_or_else(|| "write 1, 2 or 4".to_owned())
    }
}

impl PatchGrids {
    /// Whether each grid is shifted by half a patch, by row and by column.
    const fn half_shifts(self) -> &'static [[usize; 2]] {
        match self {
            Self::One => &[[0, 0]],
            Self::Two => &[[0, 0], [1, 1]],
            Self::Four => &[[0, 0], [0, 1], [1, 0], [1, 1]],
        }
    }

    /// Returns the number of patches of every grid of an image, `[rows, columns]`: a shifted grid has one more.
    pub(crate) fn patches(self, [rows, columns]: [usize; 2]) -> impl Iterator<Item = [usize; 2]> {
        self.half_shifts().iter().map(move |[down, right]| [rows + down, columns + right])
    }

    /// Returns the mean of the images that `draw` returns for every grid. A pixel of an image counts by its distance from
    /// the sides of its patch.
    ///
    /// # Shapes
    /// - `draw`: of cameras of any size, `[batch, views, height, width, 3]`
    /// - returns `[batch, views, height, width, 3]` of the size of `targets`
    pub(crate) fn mean(self, patch_size: usize, targets: &Cameras, draw: impl Fn(&Cameras) -> Tensor<5>) -> Tensor<5> {
        let shifts: Vec<[usize; 2]> =
            self.half_shifts().iter().map(|halves| halves.map(|half| half * (patch_size / 2))).collect();
        let [first, rest @ ..] = &shifts[..] else { unreachable!("every variant has a grid") };
        if rest.is_empty() || patch_size == 1 {
            return draw(targets);
        }
        let size = [targets.height, targets.width];
        let mut sums = vec![0.0; size[0] * size[1]];
        for &shift in &shifts {
            sums.iter_mut().zip(distances(size, patch_size, shift)).for_each(|(sum, distance)| *sum += distance);
        }
        let weighted = |&shift: &[usize; 2]| {
            let weights: Vec<f64> = distances(size, patch_size, shift).zip(&sums).map(|(d, sum)| d / sum).collect();
            let image = shifted(patch_size, targets, shift, &draw);
            let options = (&image.device(), image.dtype());
            image * Tensor::from_data(TensorData::new(weights, [1, 1, size[0], size[1], 1]), options)
        };
        rest.iter().fold(weighted(first), |sum, shift| sum + weighted(shift))
    }
}

/// Draws an image on a grid whose first patch begins `shift` pixels above and left of it.
fn shifted(patch_size: usize, targets: &Cameras, shift: [usize; 2], draw: impl Fn(&Cameras) -> Tensor<5>) -> Tensor<5> {
    let [down, right] = shift;
    let grown = |side: usize, shift: usize| side + if shift > 0 { patch_size } else { 0 };
    let options = (&targets.intrinsics.device(), targets.intrinsics.dtype());
    let moved = Tensor::from_data(TensorData::new(vec![0.0, 0.0, right as f64, down as f64], [1, 1, 4]), options);
    let cameras = Cameras {
        height: grown(targets.height, down),
        width: grown(targets.width, right),
        c2w: targets.c2w.clone(),
        intrinsics: targets.intrinsics.clone() + moved,
    };
    draw(&cameras).narrow(2, down, targets.height).narrow(3, right, targets.width)
}

/// Returns the distance of every pixel's center from the sides of its patch: the product of those along row and column.
fn distances(size: [usize; 2], patch_size: usize, [down, right]: [usize; 2]) -> impl Iterator<Item = f64> {
    let distance = move |pixel: usize| {
        let inside = (pixel % patch_size) as f64 + 0.5;
        inside.min(patch_size as f64 - inside)
    };
    let [height, width] = size;
    (0..height).flat_map(move |y| (0..width).map(move |x| distance(y + down) * distance(x + right)))
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
            for grids in [PatchGrids::One, PatchGrids::Two, PatchGrids::Four] {
                for patch_size in [1, 4] {
                    let targets = cameras(&device);
                    // Directions stand for colours: equal on every grid.
                    let draw = |cameras: &Cameras| plucker(cameras).narrow(4, 3, 3);
                    assert_close(&grids.mean(patch_size, &targets, draw), &draw(&targets), 2e-6);
                }
            }
        }
    }

    #[test]
    fn seams_between_patches_are_fainter() {
        let device = Device::flex();
        // A chessboard of patches: the largest jump between neighbours of a row is at a seam.
        let draw = |cameras: &Cameras| {
            let [height, width] = [cameras.height, cameras.width];
            let pixel = |i: usize| ((i / width / 4 + i % width / 4) % 2) as f32;
            let pixels: Vec<f32> = (0..height * width).map(pixel).collect();
            Tensor::<1>::from_floats(pixels.as_slice(), &device)
                .reshape([1, 1, height, width, 1])
                .expand([2, 3, height, width, 3])
        };
        let jump = |grids: PatchGrids| {
            let red: Vec<f64> = to_vec(grids.mean(4, &cameras(&device), draw)).into_iter().step_by(3).collect();
            let jumps = red.chunks(20).flat_map(|row| row.windows(2).map(|pair| (pair[0] - pair[1]).abs()));
            jumps.fold(0.0, f64::max)
        };
        assert_eq!(jump(PatchGrids::One), 1.0);
        // Halved in this worst case, and spread over four pixels.
        for grids in [PatchGrids::Two, PatchGrids::Four] {
            assert!((jump(grids) - 0.5).abs() < 1e-6, "{grids:?}: {}", jump(grids));
        }
    }

    #[test]
    fn counts_are_one_two_and_four() {
        let parse = |text: &str| serde_json::from_str::<PatchGrids>(text).map_err(|error| error.to_string());
        for (count, grids) in [(1, PatchGrids::One), (2, PatchGrids::Two), (4, PatchGrids::Four)] {
            assert_eq!((parse(&count.to_string()), usize::from(grids)), (Ok(grids), count));
            assert_eq!(count.to_string().parse(), Ok(grids));
            assert_eq!(grids.patches([3, 5]).count(), count);
        }
        assert!(parse("3").unwrap_err().contains("write 1, 2 or 4"), "{:?}", parse("3"));
        assert!("0".parse::<PatchGrids>().is_err());
        let patches: Vec<_> = PatchGrids::Four.patches([3, 5]).collect();
        assert_eq!(patches, [[3, 5], [3, 6], [4, 5], [4, 6]]);
    }
}
