//! Mirrored clips: left and right exchanged in images and cameras.

use clift_core::{Camera, ClipViews, Intrinsics, Pose};
use glam::{DMat3, DVec3};

use crate::sampling::clip::Clip;

impl Clip {
    /// Returns the mirrored clip: image columns are reversed, poses become `S c2w S` with `S = diag(-1, 1, 1)`, and
    /// principal points move from `cx` to `width - cx`.
    ///
    /// A ray `[moment, direction]` becomes `[-S moment, S direction]`. Mirroring commutes with normalisation.
    ///
    // Departs from pixelSplat, which flips before it rescales and crops: for an odd margin its crop is shifted by one
    // column. Its intrinsics stay, which is correct only for a principal point at the centre.
    #[must_use]
    pub fn flipped(&self) -> Self {
        let rows = |weights: &Vec<u8>| {
            weights.chunks_exact(self.target.width.max(1)).flat_map(|row| row.iter().rev()).copied().collect()
        };
        Self {
            key: self.key.clone(),
            context: flipped(&self.context),
            target: flipped(&self.target),
            target_weights: self.target_weights.as_ref().map(rows),
        }
    }
}

fn flipped(views: &ClipViews) -> ClipViews {
    let rows = views.images.chunks_exact((views.width * 3).max(1));
    let images = rows.flat_map(|row| row.as_chunks::<3>().0.iter().rev()).flatten().copied().collect();
    let mirrored = |camera: &Camera| Camera {
        c2w: mirrored_pose(camera.c2w),
        intrinsics: Intrinsics { cx: views.width as f64 - camera.intrinsics.cx, ..camera.intrinsics },
    };
    let cameras = views.cameras.iter().map(mirrored).collect();
    ClipViews { images, cameras, frame_index: views.frame_index.clone(), ..*views }
}

/// Returns `S pose S` with `S = diag(-1, 1, 1)`.
fn mirrored_pose(Pose { rotation, translation }: Pose) -> Pose {
    let mirror = DVec3::new(-1.0, 1.0, 1.0);
    let [x, y, z] = [rotation.x_axis, rotation.y_axis, rotation.z_axis];
    Pose { rotation: DMat3::from_cols(x * -mirror, y * mirror, z * mirror), translation: translation * mirror }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sampling::clip::ViewIndices;
    use crate::sampling::clip_reader::{ClipOptions, ClipReader};
    use crate::scene_source::SceneSource;
    use crate::synthetic::source::SyntheticSource;
    use crate::testing::{TestSource, rooms};
    use clift_core::{PoseRotation, RgbImage};
    use std::sync::Arc;

    fn mirrored(source: SyntheticSource) -> TestSource {
        let mirrored = TestSource::new(source).with_cameras(|_, mut cameras| {
            for camera in &mut cameras {
                camera.c2w = mirrored_pose(camera.c2w);
                camera.intrinsics.cx = 1.0 - camera.intrinsics.cx;
            }
            Ok(cameras)
        });
        mirrored.with_frames(|_, _, RgbImage { width, height, rgb }| {
            let rows = rgb.chunks_exact(width * 3);
            let rgb = rows.flat_map(|row| row.as_chunks::<3>().0.iter().rev()).flatten().copied().collect();
            Ok(RgbImage { width, height, rgb })
        })
    }

    fn room() -> SyntheticSource {
        rooms(|c| (c.num_scenes, c.num_frames, c.width, c.height) = (1, 9, 40, 24))
    }

    fn read(source: Arc<dyn SceneSource>, size: [usize; 2], rotation: PoseRotation) -> Clip {
        let options = ClipOptions {
            width: size[0],
            height: size[1],
            pose_rotation: rotation,
            exact_principal_point: true,
            ..ClipOptions::default()
        };
        let views = ViewIndices { context: vec![0, 3, 8], target: vec![5, 5] };
        ClipReader { source, options }.read(0, &views).unwrap()
    }

    /// Returns moment and direction of the Plücker ray through a point of a view, in pixels.
    fn ray(views: &ClipViews, view: usize, x: f64, y: f64) -> [DVec3; 2] {
        let camera = &views.cameras[view];
        let direction = camera.direction(x, y);
        [camera.c2w.translation.cross(direction), direction]
    }

    #[test]
    fn rays_and_pixels_of_a_flipped_clip_are_mirrored() {
        let mut clip = read(Arc::new(room()), [40, 16], PoseRotation::Quaternion);
        for views in [&mut clip.context, &mut clip.target] {
            for camera in &mut views.cameras {
                camera.intrinsics.cx += 1.7;
            }
        }
        let flipped = clip.flipped();
        for (views, mirrored) in [(&clip.context, &flipped.context), (&clip.target, &flipped.target)] {
            assert_eq!((mirrored.width, mirrored.height, &mirrored.frame_index), (40, 16, &views.frame_index));
            for view in 0..views.num_views() {
                for row in 0..16 {
                    for column in 0..40 {
                        let pixel = |views: &ClipViews, column: usize| {
                            let at = ((view * 16 + row) * 40 + column) * 3;
                            views.images[at..at + 3].to_vec()
                        };
                        assert_eq!(pixel(views, column), pixel(mirrored, 39 - column));
                        let (x, y) = (column as f64 + 0.5, row as f64 + 0.5);
                        let [moment, direction] = ray(views, view, x, y);
                        let got = ray(mirrored, view, 40.0 - x, y);
                        let mirror = DVec3::new(-1.0, 1.0, 1.0);
                        for (got, expected) in got.into_iter().zip([-mirror * moment, mirror * direction]) {
                            assert!(got.abs_diff_eq(expected, 1e-12), "{got} against {expected}");
                        }
                    }
                }
            }
        }
        assert_eq!(flipped.flipped(), clip);
        assert_ne!(flipped, clip);
    }

    #[test]
    fn flipping_commutes_with_reading_a_clip() {
        for rotation in [PoseRotation::Quaternion, PoseRotation::Axes] {
            // The crop from 40 x 24 to 24 x 24 removes 8 columns on either side.
            let expected = read(Arc::new(mirrored(room())), [24, 24], rotation);
            let got = read(Arc::new(room()), [24, 24], rotation).flipped();
            for (got, expected) in [(&got.context, &expected.context), (&got.target, &expected.target)] {
                assert_eq!(got.images, expected.images);
                let numbers = |views: &ClipViews| -> Vec<f64> {
                    let numbers =
                        |camera: &Camera| camera.c2w.to_matrix_f64().into_iter().chain(camera.intrinsics.to_array());
                    views.cameras.iter().flat_map(numbers).collect()
                };
                for (got, expected) in numbers(got).iter().zip(numbers(expected)) {
                    assert!((got - expected).abs() < 1e-9, "{got} against {expected}");
                }
            }
        }
    }
}
