//! Selection against brute force in f64, edge cases, and properties.

use clift_core::{DMat3, Intrinsics, Pose};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::names::parse_value;
use crate::tokens::selection::rules::SelectionPreset;

/// Returns a camera at `origin`, rotated by `angle` about the y axis, for an image of 64 x 64.
fn camera(origin: [f64; 3], angle: f64) -> Camera {
    let c2w = Pose { rotation: DMat3::from_rotation_y(angle), translation: origin.into() };
    Camera { c2w, intrinsics: Intrinsics { fx: 60.0, fy: 60.0, cx: 32.0, cy: 32.0 } }
}

/// Samples tokens of four views, with directions to the front.
fn random_rays(count: usize, seed: u64) -> Vec<TokenRay> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut number = |most: f64| rng.random_range(-most..most);
    let origins: Vec<DVec3> = (0..4).map(|_| DVec3::new(number(1.0), number(0.3), number(0.5))).collect();
    (0..count)
        .map(|token| TokenRay { origin: origins[token % 4], direction: DVec3::new(number(1.0), number(1.0), 1.0) })
        .collect()
}

/// Algorithm 1 by loops, `acos` and sorting, in f64.
struct BruteForce {
    rules: SelectionRules,
    rays: Vec<TokenRay>,
    frames: Vec<(Vec<Vec<f64>>, Vec<usize>)>,
    last_axis: Option<DVec3>,
    grid: [usize; 2],
}

impl BruteForce {
    fn select(&mut self, camera: &Camera, height: usize, width: usize, count: usize) -> Vec<u32> {
        let rules = self.rules;
        let count = count.min(self.rays.len());
        let side = if rules.scaled { height.min(width) as f64 / 16.0 } else { 16.0 };
        let [rows, columns] = [height, width].map(|pixels| (pixels as f64 / side).ceil() as usize + 8);
        let cells: Vec<DVec3> = (0..rows * columns)
            .map(|cell| {
                let pixel = |index: usize| (index as f64 - 4.0 + 0.5) * side;
                camera.direction(pixel(cell % columns), pixel(cell / columns))
            })
            .collect();
        let axis = camera.c2w.rotation.z_axis;
        let turned = self.last_axis.map(|last| last.dot(axis).min(1.0).acos());
        if rules.scaled && turned.is_some_and(|turned| turned > (side / camera.intrinsics.fx).atan()) {
            self.frames.clear();
        }
        self.last_axis = Some(axis);
        let mut field = vec![vec![0.0; self.rays.len()]; cells.len()];
        for (q, cell) in cells.iter().enumerate() {
            for (s, ray) in self.rays.iter().enumerate() {
                let cosine = ray.direction.normalize().dot(*cell);
                let apart = ray.origin.distance(camera.c2w.translation);
                let mut distance = cosine.clamp(-1.0, 1.0).acos() + f64::from(DISTANCE_WEIGHT) * apart;
                if let Some((previous, chosen)) = self.frames.last() {
                    if rules.per_cell && chosen.contains(&s) {
                        distance -= f64::from(PREVIOUS_BONUS);
                    }
                    // A grid of another shape has no previous distances.
                    let keeps = rules.per_cell && self.grid == [rows, columns];
                    let momentum = if keeps { f64::from(MOMENTUM) } else { 0.0 };
                    distance = (1.0 - momentum) * distance + momentum * previous[q][s];
                }
                field[q][s] = distance;
            }
        }
        self.grid = [rows, columns];
        let nearest = |tokens: &[usize], distance: &dyn Fn(usize) -> f64, count: usize| {
            let mut sorted = tokens.to_vec();
            sorted.sort_by(|&a, &b| distance(a).total_cmp(&distance(b)).then(a.cmp(&b)));
            sorted.truncate(count);
            sorted
        };
        let all: Vec<usize> = (0..self.rays.len()).collect();
        let to_any_cell = |s: usize| field.iter().map(|row| row[s]).fold(f64::INFINITY, f64::min);
        let per_cell = if rules.per_cell { count / cells.len() } else { 0 };
        let mut union: Vec<usize> = field.iter().flat_map(|row| nearest(&all, &|s| row[s], per_cell)).collect();
        union.sort_unstable();
        union.dedup();
        let mut chosen = nearest(&union, &to_any_cell, count);
        let rest: Vec<usize> = all.into_iter().filter(|token| !union.contains(token)).collect();
        chosen.extend(nearest(&rest, &to_any_cell, count - chosen.len()));
        chosen.sort_unstable();
        self.frames.push((field, chosen.clone()));
        chosen.into_iter().map(|token| token as u32).collect()
    }
}

#[test]
fn frames_equal_brute_force_for_0_to_7_tokens_per_cell() {
    // A grid of (2 + 8) x (1 + 8) = 90 cells: n is 0, 0, 1, 3, 5, 6 and 7.
    let (height, width) = (32, 16);
    assert_eq!(SelectionPreset::Paper.rules().grid(height, width), [10, 9]);
    let rays = random_rays(700, 1);
    for &preset in SelectionPreset::ALL {
        for count in [1, 89, 90, 350, 470, 600, 699, 700] {
            let mut selector = Selector::new(preset.rules(), &rays).unwrap();
            let mut expected = BruteForce {
                rules: preset.rules(),
                rays: rays.clone(),
                frames: Vec::new(),
                last_axis: None,
                grid: [0; 2],
            };
            // A slow turn, a turn that is a cut for `scaled`, whose cells span 1 / 60, a slow turn, and another grid of
            // as many cells, whose central cell is elsewhere.
            for (frame, angle) in (0..).zip([0.0, 0.01, 0.16, 0.17, 0.175]) {
                let [height, width] = if frame == 4 && !preset.rules().scaled { [16, 32] } else { [height, width] };
                let view = camera([0.2 * f64::from(frame), 0.0, 0.1], angle);
                let got = selector.select(&view, height, width, count).unwrap();
                assert_eq!(got.len(), count);
                assert_eq!(got, expected.select(&view, height, width, count), "{preset:?}, {count}, frame {frame}");
            }
        }
    }
}

#[test]
fn ties_go_to_the_lower_ids() {
    let ray = TokenRay { origin: DVec3::new(0.1, 0.2, 0.3), direction: DVec3::new(0.0, 0.1, 1.0) };
    for &preset in SelectionPreset::ALL {
        let mut selector = Selector::new(preset.rules(), &[ray; 300]).unwrap();
        for count in [1, 7, 81, 170, 299] {
            selector.reset();
            let chosen = selector.select(&camera([0.0; 3], 0.0), 16, 16, count).unwrap();
            assert_eq!(chosen, (0..count as u32).collect::<Vec<_>>(), "{preset:?}");
        }
    }
}

#[test]
fn camera_distance_has_weight_one_fiftieth() {
    let rays = [DVec3::X, 0.2 * DVec3::Y].map(|origin| TokenRay { origin, direction: DVec3::Z });
    let mut selector = Selector::new(SelectionPreset::Global.rules(), &rays).unwrap();
    assert_eq!(selector.select(&camera([0.0; 3], 0.0), 16, 16, 1).unwrap(), [1]);
    assert_eq!(selector.select(&camera([0.9, 0.0, 0.0], 0.0), 16, 16, 1).unwrap(), [0]);
}

#[test]
fn zero_tokens_and_non_finite_inputs_are_refused() {
    let rays = random_rays(3, 4);
    let mut selector = Selector::new(SelectionPreset::Paper.rules(), &rays).unwrap();
    let message = selector.select(&camera([0.0; 3], 0.0), 16, 16, 0).unwrap_err().to_string();
    assert_eq!(message, "`num_render_tokens` = 0: write at least 1");
    let message = selector.select(&camera([f64::NAN, 0.0, 0.0], 0.0), 16, 16, 1).unwrap_err().to_string();
    assert!(message.starts_with("the target's camera holds NaN"), "{message}");
    for direction in [[0.0; 3], [f64::NAN, 0.0, 1.0], [f64::INFINITY, 0.0, 1.0]] {
        let rays = [rays[0], TokenRay { direction: direction.into(), ..rays[1] }];
        let message = Selector::new(SelectionPreset::Paper.rules(), &rays).unwrap_err().to_string();
        assert!(message.starts_with("invalid ray of token 1"), "{message}");
    }
    let parsed = |name: &str| parse_value::<SelectionPreset>("selection", name);
    assert_eq!(parsed("global").unwrap(), SelectionPreset::Global);
    assert_eq!(parsed("all").unwrap_err().to_string(), "`selection` = all: write one of paper, global, scaled");
}
