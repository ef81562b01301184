//! Selection against brute force in f64, its edges, and properties.

use crate::SelectionPreset;
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;

/// A camera at `origin` turned by `angle` about the y axis, for a picture of 64 x 64.
fn camera(origin: [f64; 3], angle: f64) -> ViewCamera {
    let (sin, cos) = angle.sin_cos();
    let [x, y, z] = origin;
    ViewCamera {
        c2w: [cos, 0.0, sin, x, 0.0, 1.0, 0.0, y, -sin, 0.0, cos, z, 0.0, 0.0, 0.0, 1.0],
        intrinsics: [60.0, 60.0, 32.0, 32.0],
    }
}

/// Tokens of four views, every direction in front of them.
fn random_rays(count: usize, seed: u64) -> Vec<TokenRay> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut number = |most: f64| rng.random_range(-most..most);
    let origins: Vec<[f64; 3]> = (0..4).map(|_| [number(1.0), number(0.3), number(0.5)]).collect();
    (0..count)
        .map(|token| TokenRay { origin: origins[token % 4], direction: [number(1.0), number(1.0), 1.0] })
        .collect()
}

/// Algorithm 1 with nothing but loops, `acos` and sorting, in f64.
struct BruteForce {
    rules: SelectionRules,
    rays: Vec<TokenRay>,
    frames: Vec<(Vec<Vec<f64>>, Vec<usize>)>,
    forward: Option<[f64; 3]>,
}

impl BruteForce {
    fn select(&mut self, camera: &ViewCamera, height: usize, width: usize, count: usize) -> Vec<u32> {
        let rules = self.rules;
        let count = count.min(self.rays.len());
        let side = if rules.scaled_cells { height.min(width) as f64 / 16.0 } else { 16.0 };
        let [rows, columns] = [height, width].map(|pixels| (pixels as f64 / side).ceil() as usize + 8);
        let cells: Vec<[f64; 3]> = (0..rows * columns)
            .map(|cell| {
                let pixel = |index: usize| (index as f64 - 4.0 + 0.5) * side;
                camera.direction(pixel(cell % columns), pixel(cell / columns))
            })
            .collect();
        // The third column of the pose: where the camera looks.
        let forward = [2, 6, 10].map(|i| camera.c2w[i]);
        let turned = self.forward.map(|last| last.iter().zip(forward).map(|(a, b)| a * b).sum::<f64>().min(1.0).acos());
        if rules.cuts && turned.is_some_and(|turned| turned > (side / camera.intrinsics[0]).atan()) {
            self.frames.clear();
        }
        self.forward = Some(forward);
        let unit = |v: [f64; 3]| v.map(|x| x / v.iter().map(|x| x * x).sum::<f64>().sqrt());
        let mut field = vec![vec![0.0; self.rays.len()]; cells.len()];
        for (q, cell) in cells.iter().enumerate() {
            for (s, ray) in self.rays.iter().enumerate() {
                let cosine: f64 = unit(ray.direction).iter().zip(cell).map(|(a, b)| a * b).sum();
                let apart: f64 = ray.origin.iter().zip(camera.origin()).map(|(a, b)| (a - b).powi(2)).sum();
                let mut distance = f64::from(rules.angle_weight) * cosine.clamp(-1.0, 1.0).acos()
                    + f64::from(rules.distance_weight) * apart.sqrt();
                if let Some((previous, chosen)) = self.frames.last() {
                    if chosen.contains(&s) {
                        distance -= f64::from(rules.previous_bonus);
                    }
                    let momentum = f64::from(rules.momentum);
                    distance = (1.0 - momentum) * distance + momentum * previous[q][s];
                }
                field[q][s] = distance;
            }
        }
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
fn the_angle_is_that_of_acos_from_equal_to_opposite_directions() {
    for step in 0..=100_000 {
        let exact = f64::from(step) / 100_000.0 * std::f64::consts::PI;
        let got = f64::from(angle((2.0 * (exact / 2.0).sin()).powi(2) as f32));
        // Near half a turn, 4 - u keeps the absolute rounding of u: 5e-4 there, where no token is ever near.
        let tolerance = if exact < 3.0 { 1e-6 } else { 1e-3 };
        assert!((got - exact).abs() < tolerance, "{got} against {exact}");
    }
    assert_eq!(angle(0.0), 0.0);
}

#[test]
fn frames_equal_brute_force_for_no_some_and_many_tokens_per_cell() {
    // A grid of (2 + 8) x (1 + 8) = 90 cells: n is 0, 0, 1, 3, 5, 6 and 7.
    let (height, width) = (32, 16);
    assert_eq!(SelectionRules::default().grid(height, width), [10, 9]);
    let rays = random_rays(700, 1);
    for preset in SelectionPreset::ALL {
        for count in [1, 89, 90, 350, 470, 600, 699, 700] {
            let mut selector = Selector::new(preset.rules(), &rays).unwrap();
            let mut expected =
                BruteForce { rules: preset.rules(), rays: rays.clone(), frames: Vec::new(), forward: None };
            // A slow turn, a jump that `scaled` takes for a cut, and a slow turn again: its cells span 1 / 60.
            for (frame, angle) in (0..).zip([0.0, 0.01, 0.16, 0.17]) {
                let view = camera([0.2 * f64::from(frame), 0.0, 0.1], angle);
                let got = selector.select(&view, height, width, count).unwrap();
                assert_eq!(got.len(), count);
                assert_eq!(got, expected.select(&view, height, width, count), "{preset:?}, {count}, frame {frame}");
            }
        }
    }
}

#[test]
fn more_tokens_than_there_are_gives_all_of_them_once() {
    let mut selector = Selector::new(SelectionRules::default(), &random_rays(50, 2)).unwrap();
    for count in [50, 51, 100_000] {
        assert_eq!(selector.select(&camera([0.0; 3], 0.0), 64, 64, count).unwrap(), (0..50).collect::<Vec<_>>());
    }
}

#[test]
fn a_first_step_that_takes_too_many_keeps_the_nearest() {
    let mut found = Nearest::none(6, true);
    found.distance = vec![0.5, 0.1, 0.5, 0.4, 0.3, 0.2];
    found.taken = vec![true, true, true, true, true, false];
    assert_eq!(found.choose(3), [1, 3, 4]);
    assert_eq!(found.choose(4), [0, 1, 3, 4], "tokens 0 and 2 are equally near");
    assert_eq!(found.choose(5), [0, 1, 2, 3, 4], "a taken token goes before a nearer one that is not");
    assert_eq!(found.choose(6), [0, 1, 2, 3, 4, 5]);
}

#[test]
fn of_equally_near_tokens_the_lower_ids_are_taken() {
    let ray = TokenRay { origin: [0.1, 0.2, 0.3], direction: [0.0, 0.1, 1.0] };
    for preset in SelectionPreset::ALL {
        let mut selector = Selector::new(preset.rules(), &[ray; 300]).unwrap();
        for count in [1, 7, 81, 170, 299] {
            selector.reset();
            let chosen = selector.select(&camera([0.0; 3], 0.0), 16, 16, count).unwrap();
            assert_eq!(chosen, (0..count as u32).collect::<Vec<_>>(), "{preset:?}");
        }
    }
}

/// Two tokens that look ahead, turned by these angles.
fn two_tokens(angles: [f64; 2]) -> [TokenRay; 2] {
    angles.map(|angle| TokenRay { origin: [0.0; 3], direction: [angle.tan(), 0.0, 1.0] })
}

/// Rules under which a picture of one cell sees tokens by their angle alone.
const PLAIN: SelectionRules = SelectionRules {
    angle_weight: 1.0,
    distance_weight: 0.0,
    previous_bonus: 0.0,
    momentum: 0.0,
    per_cell: false,
    scaled_cells: false,
    cuts: false,
};

#[test]
fn a_token_of_the_previous_frame_stays_until_another_is_nearer_by_the_bonus() {
    // The token at 0 is nearer at first; the camera then turns towards the one at 0.05.
    let near = |bonus: f32, turn: f64| {
        let rules = SelectionRules { previous_bonus: bonus, ..PLAIN };
        let mut selector = Selector::new(rules, &two_tokens([0.0, 0.05])).unwrap();
        let camera = |angle: f64| {
            let mut view = camera([0.0; 3], angle);
            // So long a focal length that all cells look the same way, within 1e-4.
            view.intrinsics = [1e6, 1e6, 8.0, 8.0];
            view
        };
        let first = selector.select(&camera(0.0), 16, 16, 1).unwrap();
        assert_eq!(first, [0]);
        selector.select(&camera(turn), 16, 16, 1).unwrap()[0]
    };
    assert_eq!(near(0.0, 0.03), 1, "0.02 against 0.03");
    assert_eq!(near(0.03, 0.03), 0, "0.02 against 0.03 - 0.03");
    assert_eq!(near(0.03, 0.0405), 1, "0.0095 against 0.0405 - 0.03");
}

#[test]
fn momentum_halves_a_step_of_the_distances() {
    let rules = SelectionRules { momentum: 0.5, ..PLAIN };
    let mut selector = Selector::new(rules, &two_tokens([0.0, 0.1])).unwrap();
    let camera = |angle: f64| {
        let mut view = camera([0.0; 3], angle);
        view.intrinsics = [1e6, 1e6, 8.0, 8.0];
        view
    };
    let middle = 4 * 9 + 4;
    let distances = |selector: &Selector| [selector.field[middle][0], selector.field[middle][1]].map(f64::from);
    let close = |got: [f64; 2], expected: [f64; 2]| {
        assert!(got.iter().zip(expected).all(|(a, b)| (a - b).abs() < 2e-6), "{got:?} against {expected:?}");
    };
    selector.select(&camera(0.0), 16, 16, 1).unwrap();
    close(distances(&selector), [0.0, 0.1]);
    assert_eq!(selector.select(&camera(0.08), 16, 16, 1).unwrap(), [0], "0.04 against 0.06");
    close(distances(&selector), [0.04, 0.06]);
    // What is carried on is the smoothed field, not the last frame's own distances.
    assert_eq!(selector.select(&camera(0.08), 16, 16, 1).unwrap(), [1]);
    close(distances(&selector), [0.06, 0.04]);
    // Another picture size has another grid, which starts without momentum.
    selector.select(&camera(0.0), 16, 32, 1).unwrap();
    assert_eq!(selector.select(&camera(0.08), 16, 16, 1).unwrap(), [1]);
    close(distances(&selector), [0.08, 0.02]);
}

#[test]
fn a_cut_starts_without_momentum_where_the_rules_know_cuts() {
    let distance = |cuts: bool, turn: f64| {
        let rules = SelectionRules { momentum: 0.5, cuts, ..PLAIN };
        let mut selector = Selector::new(rules, &two_tokens([0.0, 0.1])).unwrap();
        let view = |angle: f64| ViewCamera { intrinsics: [400.0, 400.0, 8.0, 8.0], ..camera([0.0; 3], angle) };
        selector.select(&view(0.0), 16, 16, 1).unwrap();
        selector.select(&view(turn), 16, 16, 1).unwrap();
        f64::from(selector.field[4 * 9 + 4][0])
    };
    // A cell of 16 pixels spans 0.04: a turn by 0.03 is smoothed, one by 0.05 a cut.
    for (cuts, turn, expected) in [(true, 0.03, 0.015), (true, 0.05, 0.05), (false, 0.05, 0.025)] {
        assert!((distance(cuts, turn) - expected).abs() < 2e-6, "{cuts}, {turn}: {}", distance(cuts, turn));
    }
}

#[test]
fn the_camera_of_a_token_counts_a_fiftieth_of_its_distance() {
    let direction = [0.0, 0.0, 1.0];
    let rays = [TokenRay { origin: [1.0, 0.0, 0.0], direction }, TokenRay { origin: [0.0, 0.2, 0.0], direction }];
    let mut selector = Selector::new(SelectionPreset::Global.rules(), &rays).unwrap();
    assert_eq!(selector.select(&camera([0.0; 3], 0.0), 16, 16, 1).unwrap(), [1]);
    assert_eq!(selector.select(&camera([0.9, 0.0, 0.0], 0.0), 16, 16, 1).unwrap(), [0]);
}

#[test]
fn the_grid_covers_the_picture_with_four_cells_around_it() {
    let [paper, scaled] = [SelectionPreset::Paper, SelectionPreset::Scaled].map(SelectionPreset::rules);
    assert_eq!(paper.grid(256, 256), [24, 24]);
    assert_eq!(paper.grid(256, 448), [24, 36]);
    assert_eq!(paper.grid(40, 17), [11, 10]);
    for (height, width) in [(256, 256), (256, 448)] {
        assert_eq!(scaled.grid(height, width), paper.grid(height, width));
    }
    assert_eq!(scaled.grid(32, 64), [24, 40]);
    let view = camera([0.0; 3], 0.0);
    let cells = paper.cell_directions(&view, 64, 64);
    assert_eq!(cells.len(), 144);
    assert_eq!(cells[0], view.direction(-56.0, -56.0));
    assert_eq!(cells[4 * 12 + 4], view.direction(8.0, 8.0), "the first cell inside");
    assert_eq!(cells[143], view.direction(120.0, 120.0));
    let cells = scaled.cell_directions(&view, 64, 64);
    assert_eq!(cells[0], view.direction(-14.0, -14.0), "a quarter of the picture to each side");
    assert_eq!(cells[4 * 24 + 4], view.direction(2.0, 2.0));
}

#[test]
fn what_cannot_be_selected_from_is_refused() {
    let rays = random_rays(3, 4);
    let mut selector = Selector::new(SelectionRules::default(), &rays).unwrap();
    let message = selector.select(&camera([0.0; 3], 0.0), 16, 16, 0).unwrap_err().to_string();
    assert_eq!(message, "`num_render_tokens` = 0: write at least 1");
    let message = selector.select(&camera([f64::NAN, 0.0, 0.0], 0.0), 16, 16, 1).unwrap_err().to_string();
    assert!(message.starts_with("the target's camera holds NaN"), "{message}");
    for direction in [[0.0; 3], [f64::NAN, 0.0, 1.0], [f64::INFINITY, 0.0, 1.0]] {
        let rays = [rays[0], TokenRay { direction, ..rays[1] }];
        let message = Selector::new(SelectionRules::default(), &rays).unwrap_err().to_string();
        assert!(message.starts_with("the ray of token 1 cannot be used"), "{message}");
    }
    assert_eq!("global".parse::<SelectionPreset>().unwrap(), SelectionPreset::Global);
    assert_eq!(
        "all".parse::<SelectionPreset>().unwrap_err().to_string(),
        "`selection` = all: write one of paper, global, scaled"
    );
}

#[test]
#[ignore = "measures time, which a busy machine has not"]
fn a_frame_of_8192_tokens_and_576_cells_takes_at_most_15_ms_on_two_cores() {
    let rays = random_rays(8192, 5);
    for preset in SelectionPreset::ALL {
        for count in [512, 1024, 4096, 8191] {
            let mut selector = Selector::new(preset.rules(), &rays).unwrap();
            let mut times_ms: Vec<f64> = (0..60)
                .map(|frame| {
                    let view = camera([0.01 * f64::from(frame), 0.0, 0.0], 0.01 * f64::from(frame));
                    let started = std::time::Instant::now();
                    selector.select(&view, 256, 256, count).unwrap();
                    1e3 * started.elapsed().as_secs_f64()
                })
                .collect();
            times_ms.sort_by(f64::total_cmp);
            println!("{}, {count} tokens: median {:.1} ms, p95 {:.1} ms", preset.name(), times_ms[30], times_ms[57]);
            assert!(times_ms[30] <= 15.0, "{} of {count}: {:.1} ms", preset.name(), times_ms[30]);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn every_frame_has_exactly_the_tokens_asked_for_each_once(
        num_tokens in 1_usize..400, counts in prop::collection::vec(1_usize..500, 1..5), seed in 0_u64..1000,
        height in 1_usize..40, width in 1_usize..40, preset in 0_usize..3,
    ) {
        let mut selector = Selector::new(SelectionPreset::ALL[preset].rules(), &random_rays(num_tokens, seed)).unwrap();
        for (frame, count) in counts.into_iter().enumerate() {
            let view = camera([0.1 * frame as f64, 0.0, 0.0], 0.1 * frame as f64);
            let chosen = selector.select(&view, height, width, count).unwrap();
            prop_assert_eq!(chosen.len(), count.min(num_tokens));
            prop_assert!(chosen.windows(2).all(|pair| pair[0] < pair[1]));
            prop_assert!(chosen.iter().all(|&token| (token as usize) < num_tokens));
        }
    }

    #[test]
    fn without_cells_fewer_tokens_are_part_of_more(
        num_tokens in 2_usize..300, few in 1_usize..300, more in 1_usize..300, seed in 0_u64..1000,
    ) {
        let rays = random_rays(num_tokens, seed);
        let choose = |count| {
            let mut selector = Selector::new(SelectionPreset::Global.rules(), &rays).unwrap();
            selector.select(&camera([0.0; 3], 0.0), 32, 32, count).unwrap()
        };
        let (few, more) = (choose(few.min(more)), choose(few.max(more)));
        prop_assert!(few.iter().all(|token| more.contains(token)));
    }

    #[test]
    fn renaming_tokens_renames_the_selection(num_tokens in 2_usize..200, count in 1_usize..200, seed in 0_u64..1000) {
        let rays = random_rays(num_tokens, seed);
        let reversed: Vec<TokenRay> = rays.iter().rev().copied().collect();
        let choose = |rays: &[TokenRay]| {
            let mut selector = Selector::new(SelectionRules::default(), rays).unwrap();
            selector.select(&camera([0.0; 3], 0.0), 16, 16, count).unwrap()
        };
        let mut renamed: Vec<u32> = choose(&reversed).iter().map(|&token| num_tokens as u32 - 1 - token).collect();
        renamed.sort_unstable();
        prop_assert_eq!(choose(&rays), renamed);
    }
}
