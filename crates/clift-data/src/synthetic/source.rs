//! Synthetic scenes from seeds, ray traced on demand.
//!
//! A scene is a pure function of (seed, split, index), a frame of (scene, frame). Threads need no coordination, and cameras
//! are exact.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};

use clift_core::{Camera, IntrinsicsNorm, RgbImage, step_rng};

use crate::error::DataError;
use crate::scene_source::{SceneSource, Split};
use crate::synthetic::config::{Look, SyntheticConfig};
use crate::synthetic::ray_tracer;
use crate::synthetic::real::scene::RealScene;
use crate::synthetic::room::Room;

/// Number of scenes kept for their further frames: more than threads read clips at once.
const KEPT_SCENES: usize = 16;

/// One scene in so many is a room for `look = "mixed"`.
const ROOM_EVERY: usize = 8;

/// A source of synthetic scenes, rendered on demand. Keys are `synthetic-<seed>-<split>-<index>`, and
/// `synthetic-real-<seed>-<split>-<index>` for `look = "real"`, likewise for `"mixed"`.
#[derive(Debug)]
pub struct SyntheticSource {
    config: SyntheticConfig,
    keys: Vec<String>,
    /// Scenes that were read last, the newest at the end. A scene is a function of its number: what is kept changes no frame.
    kept: Mutex<VecDeque<(usize, Arc<Scene>)>>,
}

#[derive(Debug, PartialEq)]
enum Scene {
    Room(Box<Room>),
    Real(Box<RealScene>),
}

impl SyntheticSource {
    /// Creates a source without rendering any frame.
    pub fn new(config: SyntheticConfig) -> Result<Self, DataError> {
        config.validate()?;
        let SyntheticConfig { look, seed, split, num_scenes, .. } = config;
        let kind = match look {
            Look::Rooms => "",
            Look::Real => "real-",
            Look::Mixed => "mixed-",
        };
        let keys = (0..num_scenes).map(|scene| format!("synthetic-{kind}{seed}-{split}-{scene:05}")).collect();
        Ok(Self { config, keys, kept: Mutex::default() })
    }

    fn scene(&self, scene: usize) -> Result<Arc<Scene>, DataError> {
        let num_scenes = self.config.num_scenes;
        if scene >= num_scenes {
            return Err(DataError::NoSuchScene { scene, num_scenes });
        }
        let kept = || self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, found)) = kept().iter().find(|(number, _)| *number == scene) {
            return Ok(Arc::clone(found));
        }
        let made = Arc::new(self.sample(scene));
        let mut kept = kept();
        if kept.len() == KEPT_SCENES {
            kept.pop_front();
        }
        kept.push_back((scene, Arc::clone(&made)));
        Ok(made)
    }

    fn sample(&self, scene: usize) -> Scene {
        let is_room = match self.config.look {
            Look::Rooms => true,
            Look::Real => false,
            Look::Mixed => scene.is_multiple_of(ROOM_EVERY),
        };
        let purpose = match (is_room, self.config.split) {
            (true, Split::Train) => "synthetic train scene",
            (true, Split::Test) => "synthetic test scene",
            (false, Split::Train) => "synthetic real train scene",
            (false, Split::Test) => "synthetic real test scene",
        };
        let mut rng = step_rng(self.config.seed, scene as u64, purpose);
        if is_room {
            Scene::Room(Box::new(Room::sample(&mut rng, &self.config)))
        } else {
            Scene::Real(Box::new(RealScene::sample(rng, self.config.look == Look::Mixed)))
        }
    }

    fn camera(&self, scene: &Scene, frame: usize) -> Camera<IntrinsicsNorm> {
        let SyntheticConfig { num_frames, width, height, fov_deg, .. } = self.config;
        let time = frame as f64 / (num_frames - 1).max(1) as f64;
        let aspect = width as f64 / height as f64;
        match scene {
            Scene::Room(room) => room.path.camera(time, fov_deg, aspect),
            Scene::Real(scene) => scene.path.camera(time as f32, aspect, frame),
        }
    }
}

impl SceneSource for SyntheticSource {
    fn num_scenes(&self) -> usize {
        self.config.num_scenes
    }

    fn key(&self, scene: usize) -> &str {
        &self.keys[scene]
    }

    fn find(&self, key: &str) -> Option<usize> {
        let (_, number) = key.rsplit_once('-')?;
        number.parse().ok().filter(|&scene: &usize| self.keys.get(scene).is_some_and(|found| found == key))
    }

    fn num_frames(&self, scene: usize) -> Result<usize, DataError> {
        let SyntheticConfig { num_scenes, num_frames, .. } = self.config;
        if scene < num_scenes { Ok(num_frames) } else { Err(DataError::NoSuchScene { scene, num_scenes }) }
    }

    fn cameras(&self, scene: usize) -> Result<Vec<Camera<IntrinsicsNorm>>, DataError> {
        let scene = self.scene(scene)?;
        Ok((0..self.config.num_frames).map(|frame| self.camera(&scene, frame)).collect())
    }

    fn image_size(&self, _scene: usize, _frame: usize) -> Result<[usize; 2], DataError> {
        Ok([self.config.width, self.config.height])
    }

    fn frame(&self, scene: usize, frame: usize) -> Result<RgbImage, DataError> {
        let found = self.scene(scene)?;
        let SyntheticConfig { num_frames, width, height, samples_per_pixel, specular, .. } = self.config;
        if frame >= num_frames {
            return Err(DataError::NoSuchFrame { key: self.key(scene).to_owned(), frame, num_frames });
        }
        let camera = self.camera(&found, frame);
        Ok(match &*found {
            Scene::Room(room) => {
                ray_tracer::render(room, &camera, width, height, samples_per_pixel.isqrt(), specular as f32)
            }
            Scene::Real(scene) => scene.render(&camera, frame, [width, height]),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::codec::decode_image;
    use crate::testing::rooms as source;
    use std::collections::BTreeSet;
    use std::path::Path;

    fn real(change: impl FnOnce(&mut SyntheticConfig)) -> SyntheticSource {
        source(|c| {
            c.look = Look::Real;
            change(c);
        })
    }

    #[test]
    fn frames_depend_on_seed_and_position_alone() {
        for look in [Look::Rooms, Look::Real] {
            let of = |seed, num_scenes| source(|c| (c.look, c.seed, c.num_scenes) = (look, seed, num_scenes));
            let (source, again) = (of(0, 8), of(0, 100));
            let first = source.frame(7, 3).unwrap();
            assert_eq!((first.width, first.height, first.rgb.len()), (32, 32, 32 * 32 * 3));
            // More scenes than are kept lie between the two reads.
            for scene in (0..2 * KEPT_SCENES).rev() {
                again.cameras(scene).unwrap();
            }
            assert_eq!([again.frame(7, 3).unwrap(), again.frame(7, 3).unwrap()], [first.clone(), first.clone()]);
            assert_eq!(again.kept.lock().unwrap().len(), KEPT_SCENES);
            let test = SyntheticSource::new(SyntheticConfig { split: Split::Test, ..source.config.clone() }).unwrap();
            for other in [source.frame(7, 4), again.frame(8, 3), of(1, 8).frame(7, 3), test.frame(7, 3)] {
                assert_ne!(first, other.unwrap());
            }
        }
    }

    /// `models/rooms` was trained on these scenes: its training is repeatable as long as the generator makes the same
    /// frames. The sheet of the documentation, from `examples/synthetic_sheet.rs`, has every fourth level.
    #[test]
    fn real_frames_are_those_of_the_sheet() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/images/real-look.png");
        let sheet = decode_image(&std::fs::read(path).unwrap(), "sheet", 0).unwrap();
        let source = real(|c| (c.num_scenes, c.num_frames, c.width, c.height) = (64, 32, 64, 64));
        let mut num_other = 0;
        for scene in 0..64 {
            let frame = source.frame(scene, 16).unwrap();
            for (row, line) in frame.rgb.chunks_exact(64 * 3).enumerate() {
                let start = (scene / 8 * 64 + row) * sheet.width + scene % 8 * 64;
                let expected = &sheet.rgb[start * 3..][..line.len()];
                num_other +=
                    line.iter().zip(expected).filter(|(value, expected)| (*value & !3) | 2 != **expected).count();
            }
        }
        // Other mathematical libraries may round a few edges and levels differently.
        assert!(num_other <= sheet.rgb.len() / 1000, "{num_other} of {} values differ", sheet.rgb.len());
    }

    #[test]
    fn mixed_scenes_are_rooms_and_places_whose_frames_differ_in_roll_and_zoom() {
        let of = |look| source(|c| (c.look, c.num_scenes) = (look, 40));
        let [mixed, real, rooms] = [Look::Mixed, Look::Real, Look::Rooms].map(of);
        let mut most: [f64; 2] = [0.0; 2];
        for scene in 0..40 {
            if scene % 8 == 0 {
                assert_eq!(mixed.sample(scene), rooms.sample(scene), "{scene}");
                continue;
            }
            let (mixed_cameras, real_cameras) = (mixed.cameras(scene).unwrap(), real.cameras(scene).unwrap());
            for (camera, plain) in mixed_cameras.iter().zip(&real_cameras) {
                most[0] = most[0].max((camera.c2w.rotation.x_axis.y - plain.c2w.rotation.x_axis.y).abs());
                most[1] = most[1].max((camera.intrinsics.fx / plain.intrinsics.fx).ln().abs());
            }
        }
        let [roll, zoom] = most;
        assert!((0.2..0.6).contains(&roll) && (0.1..0.26).contains(&zoom), "{most:?}");
    }

    #[test]
    fn plain_share_sets_the_number_of_empty_rooms() {
        let num_plain = |plain_share| {
            let source = source(|c| c.plain_share = plain_share);
            let is_plain =
                |scene: &usize| matches!(source.sample(*scene), Scene::Room(room) if room.objects.is_empty());
            (0..200).filter(is_plain).count()
        };
        assert_eq!((num_plain(0.0), num_plain(1.0)), (0, 200));
        // Four standard deviations of 200 samples: 28.
        assert!((72..=128).contains(&num_plain(0.5)), "{}", num_plain(0.5));
    }

    #[test]
    fn keys_are_unique_and_found() {
        let source = source(|c| (c.seed, c.num_scenes) = (7, 3_000));
        let keys: BTreeSet<&str> = (0..3_000).map(|scene| source.key(scene)).collect();
        assert_eq!(keys.len(), 3_000);
        assert_eq!(source.key(42), "synthetic-7-train-00042");
        let real = real(|c| (c.seed, c.split) = (7, Split::Test));
        assert_eq!(real.key(42), "synthetic-real-7-test-00042");
        assert_eq!((real.find(real.key(42)), real.find("synthetic-7-test-00042")), (Some(42), None));
        assert!((0..3_000).all(|scene| source.find(source.key(scene)) == Some(scene)));
        for wrong in
            ["synthetic-7-train-03000", "synthetic-7-train-42", "synthetic-7-test-00042", "synthetic-7-train-+0042", ""]
        {
            assert_eq!(source.find(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn positions_beyond_the_end_are_refused() {
        let source = source(|c| c.num_scenes = 5);
        let message = |scene, frame| source.frame(scene, frame).unwrap_err().to_string();
        assert_eq!(message(5, 0), "the source has 5 scenes; scene 5 (counted from 0) does not exist");
        let missing = "scene synthetic-0-train-00004 has 16 frames; frame 16 (counted from 0) does not exist";
        assert_eq!(message(4, 16), missing);
        assert!(source.cameras(5).is_err() && source.num_frames(5).is_err());
        assert_eq!(source.num_frames(4).unwrap(), 16);
    }
}
