//! Renderings of scenes, groups and windows against independent references.

use clift_model::{CameraEncoding, Network, Precision, SelectionPreset, psnr, save_weights};

use super::*;
use crate::scene::scene::tests::{camera, scene, scene_of_groups};
use crate::testing::{devices, small_clift};

fn encoded(camera_encoding: CameraEncoding) -> ModelConfig {
    ModelConfig { camera_encoding, ..small_clift() }
}

/// `scene` with tokens for all of its `count` patches.
fn with_tokens(scene: Scene, count: u32, renderer: &Renderer, config: &ModelConfig) -> Scene {
    let tokens = (0..count * 16).map(|i| ((i * 37 % 101) as f32 - 50.0) * 0.02).collect();
    let renderer_hash = renderer_hash(renderer, config);
    Scene { model: config.clone(), renderer_hash, tokens, token_ids: (0..count).collect(), ..scene }
}

/// A scene with all 12 tokens of two views of 24 x 16 pixels.
fn whole_scene(renderer: &Renderer, config: &ModelConfig) -> Scene {
    with_tokens(scene(), 12, renderer, config)
}

fn path(num_frames: usize) -> Vec<Camera> {
    (0..num_frames).map(|i| camera(-0.5 + 0.1 * i as f64, 0.1 - 0.02 * i as f64)).collect()
}

fn assert_equals_single_frames(
    device: &Device,
    config: &ModelConfig,
    preset: SelectionPreset,
    count: usize,
    tolerance: f32,
) {
    let renderer = Network::new(config, 3, device).renderer;
    let scene = whole_scene(&renderer, config);
    let context = Cameras::of_views(&scene.context, scene.height, scene.width, device).unwrap();
    let mut scene_renderer = SceneRenderer::new(&scene, renderer.clone(), preset.rules(), device).unwrap();
    let mut selector = Selector::new(preset.rules(), &scene.token_rays()).unwrap();
    let rendered = scene_renderer.render(&path(11), 16, 24, count).unwrap();
    assert_eq!(rendered.len(), 11);
    for (view, rendered) in path(11).iter().zip(&rendered) {
        let selected = (count < 12).then(|| selector.select(view, 16, 24, count).unwrap());
        assert_eq!(rendered.tokens, selected);
        let ids = selected.unwrap_or_else(|| (0..12).collect());
        let values = ids.iter().flat_map(|&id| &scene.tokens[id as usize * 16..][..16]).copied();
        let values = TensorData::new(values.collect::<Vec<f32>>(), [1, count, 16]);
        let tokens = Tokens::of_patches(config, Tensor::from_data(values, device), &context, &ids);
        let cameras = Cameras::of_views(&[*view], 16, 24, device).unwrap();
        let alone = renderer.forward(tokens, &cameras).into_data().convert::<f32>();
        let alone = alone.as_slice::<f32>().unwrap();
        assert_eq!(alone.len(), rendered.pixels.len());
        let error = rendered.pixels.iter().zip(alone).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(error <= tolerance, "{error} with {count} tokens");
    }
}

#[test]
fn frames_equal_images_of_their_tokens_alone() {
    for config in CameraEncoding::ALL.map(encoded) {
        for device in devices() {
            // Matrix products of eight views have other block sizes than those of one view.
            assert_equals_single_frames(&device, &config, SelectionPreset::Paper, 12, 1e-5);
        }
        for &preset in SelectionPreset::ALL {
            assert_equals_single_frames(&Device::flex(), &config, preset, 5, 0.0);
        }
    }
}

#[test]
fn a_view_is_rendered_from_the_nearest_group_in_its_frame() {
    let device = Device::flex();
    for config in CameraEncoding::ALL.map(encoded) {
        let renderer = Network::new(&config, 3, &device).renderer;
        let scene = with_tokens(scene_of_groups(), 24, &renderer, &config);
        let rules = SelectionPreset::Paper.rules();
        let mut whole = SceneRenderer::new(&scene, renderer.clone(), rules, &device).unwrap();
        for (group, view) in [(0, scene.context[0]), (1, scene.context[2])] {
            // The group alone, in its frame.
            let ContextGroup { views, frame } = &scene.groups[group];
            let alone = Scene {
                context: scene.group_cameras(&scene.groups[group]),
                context_frames: vec![0; views.len()],
                groups: vec![ContextGroup::of_all(views.len())],
                token_ids: (0..12).collect(),
                tokens: scene.tokens[group * 12 * 16..][..12 * 16].to_vec(),
                ..scene.clone()
            };
            let mut alone = SceneRenderer::new(&alone, renderer.clone(), rules, &device).unwrap();
            for count in [5, 12] {
                let expected = Camera { c2w: frame.normalize(view.c2w), ..view };
                let expected = alone.render(&[expected], 16, 24, count).unwrap().remove(0);
                let got = whole.render(&[view], 16, 24, count).unwrap().remove(0);
                assert_eq!(got.pixels, expected.pixels, "group {group}, {count} tokens");
                assert_eq!(got.tokens.unwrap().len(), count);
                alone.reset();
                whole.reset();
            }
        }
        // Between the groups, on any number of threads, in the precision of the caller.
        let view = camera(0.1, 0.0);
        assert_eq!(whole.clone().render(&[view], 16, 24, 24).unwrap()[0].tokens.as_ref().unwrap().len(), 24);
        let pixels = |num_threads: usize, precision: Precision| {
            let threads = rayon::ThreadPoolBuilder::new().num_threads(num_threads).build().unwrap();
            let mut whole = whole.clone();
            threads.install(|| {
                let _precision = precision.scope();
                whole.render(&[view, scene.context[0]], 16, 24, 12).unwrap().remove(0).pixels
            })
        };
        let expected = pixels(1, Precision::Bf16);
        assert!(pixels(3, Precision::Bf16) == expected && pixels(3, Precision::F32) != expected);
    }
}

/// Returns the middle of a frame by bicubic convolution of an image, `scale` pixels of the image per pixel: an independent
/// reference in f64, with the filter of Pillow's BICUBIC.
fn resampled(image: &[f32], [rows, columns]: [usize; 2], scale: f64, [height, width]: [usize; 2]) -> Vec<f32> {
    let cubic = |x: f64| match x.abs() {
        x if x < 1.0 => (1.5 * x - 2.5) * x * x + 1.0,
        x if x < 2.0 => ((-0.5 * x + 2.5) * x - 4.0) * x + 2.0,
        _ => 0.0,
    };
    let taps = |from: usize, to: usize, pixel: usize| {
        let centre = (pixel as f64 + 0.5 - to as f64 / 2.0) * scale + from as f64 / 2.0 - 0.5;
        let weights: Vec<f64> = (0..from).map(|i| cubic((i as f64 - centre) / scale.max(1.0))).collect();
        let sum: f64 = weights.iter().sum();
        weights.into_iter().map(|weight| weight / sum).collect::<Vec<f64>>()
    };
    let across: Vec<Vec<f64>> = (0..width).map(|pixel| taps(columns, width, pixel)).collect();
    let down: Vec<Vec<f64>> = (0..height).map(|pixel| taps(rows, height, pixel)).collect();
    let pixel = |row: usize, column: usize, channel: usize| {
        let value = |y: usize, x: usize| f64::from(image[(y * columns + x) * 3 + channel]);
        let line = |y: usize| across[column].iter().enumerate().map(|(x, weight)| weight * value(y, x)).sum::<f64>();
        down[row].iter().enumerate().map(|(y, weight)| weight * line(y)).sum::<f64>() as f32
    };
    (0..height * width * 3).map(|i| pixel(i / 3 / width, i / 3 % width, i % 3)).collect()
}

fn middle(frame: &[f32], width: usize, columns: usize) -> Vec<f32> {
    let left = (width - columns) / 2;
    frame.chunks(width * 3).flat_map(|row| &row[left * 3..][..columns * 3]).copied().collect()
}

#[test]
fn frames_of_20_sizes_and_proportions_show_the_rendering_of_the_trained_size() {
    let device = Device::flex();
    // The trained image has 24 x 16 pixels; sizes are height and width, in its proportions, maybe rounded, and in others.
    let equal = [8, 12, 14, 16, 17, 20, 24, 32, 40, 48, 64, 128].map(|height: usize| [height, height * 3 / 2]);
    let others = [[31, 47], [16, 12], [40, 40], [64, 24], [16, 36], [24, 60], [32, 128], [48, 192]];
    for (encoding, grids) in [
        (CameraEncoding::Plucker, PatchGrids::One),
        (CameraEncoding::Gta, PatchGrids::Two),
        (CameraEncoding::Gta, PatchGrids::Four),
    ] {
        let config = ModelConfig { patch_grids: grids, ..encoded(encoding) };
        let renderer = Network::new(&config, 3, &device).renderer;
        let scene = whole_scene(&renderer, &config);
        let mut renderer = SceneRenderer::new(&scene, renderer, SelectionPreset::Paper.rules(), &device).unwrap();
        let mut frame = |size: [usize; 2], count| {
            renderer.reset();
            let view = camera(0.1, 0.2).resized([16, 24], size);
            renderer.render(&[view], size[0], size[1], count).unwrap().remove(0).pixels
        };
        for (size, count) in equal.into_iter().chain(others).flat_map(|size| [(size, 12), (size, 5)]) {
            let [height, width] = size;
            let trained = frame([16, 24], count);
            // The columns of the frame inside of the trained field of view, in the middle. Those of a wide frame mix with
            // others within the reach of the filter, two pixels.
            let inside = height * 3 / 2;
            let reach = 2 * height.div_ceil(8);
            let columns = if width > inside { inside - (width - inside) % 2 - reach } else { width };
            // Of a wide frame other tokens may be selected.
            if width > inside + 1 && count < 12 {
                continue;
            }
            let expected = resampled(&trained, [16, 24], 16.0 / height as f64, [height, columns]);
            let got = middle(&frame(size, count), width, columns);
            let db = psnr(&got, &expected).unwrap();
            assert!(db >= 45.0, "{encoding:?}, {size:?}, {count} tokens: {db} dB");
        }
    }
}

#[test]
fn frames_of_any_size_are_bounded_in_memory() {
    let sizes = [(16, 24), (512, 512), (1024, 1024), (2048, 2048), (1 << 14, 1 << 14), (0, 8)];
    assert_eq!(sizes.map(|(height, width)| frames_per_call(height, width)), [8, 8, 2, 1, 1, 8]);
    assert_eq!([[8, 8], [64, 64], [128, 128], [512, 512]].map(images_per_call), [8, 8, 2, 1]);
}

#[test]
fn a_scene_accepts_only_its_own_renderer() {
    let device = Device::flex();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.safetensors");
    let config = small_clift();
    let model = Network::new(&config, 3, &device);
    let scene = whole_scene(&model.renderer, &config);
    save_weights(&model, &path).unwrap();
    let renderer = load_renderer(&scene, &path, &device).unwrap();
    assert_eq!(renderer_hash(&renderer, &config), scene.renderer_hash);
    let assert_refused = |change: fn(&mut ModelConfig), expected: &str| {
        let mut scene = scene.clone();
        change(&mut scene.model);
        let message = load_renderer(&scene, &path, &device).unwrap_err().to_string();
        assert!(message.contains(expected), "{message}");
    };
    // The weights have the same shapes with one head as with two.
    let expected = format!("the scene was made for the renderer {}, this", &scene.renderer_hash[..12]);
    assert_refused(|model| model.num_heads = 1, &expected);
    // The same holds for camera-relative attention, which has no weights.
    assert_refused(|model| model.camera_encoding = CameraEncoding::Gta, &expected);
    save_weights(&Network::new(&config, 4, &device), &path).unwrap();
    assert_refused(|_| (), &expected);
    save_weights(&model.encoder, &path).unwrap();
    assert_refused(|model| model.num_renderer_blocks = 1, "parameters of the scene's renderer are missing");
    assert_refused(
        |model| (model.dim, model.feed_forward_dim, model.num_renderer_blocks) = (1 << 16, 1 << 18, 1 << 10),
        "the scene's renderer needs at least 14074",
    );
}

#[test]
fn shares_of_groups_add_up_and_change_continuously() {
    assert_eq!(group_shares(&[0.7]), [(0, 1.0)]);
    assert_eq!(group_shares(&[0.9, 0.2]), [(1, 1.0)], "far beyond the nearest");
    assert_eq!(group_shares(&[0.5, 0.5]), [(0, 0.5), (1, 0.5)]);
    assert_eq!(group_shares(&[0.5; 4]), [(0, 1.0)], "no room before the next after the most groups");
    let share = |distances: &[f64], group: usize| {
        group_shares(distances).iter().find(|(other, _)| *other == group).map_or(0.0, |(_, share)| *share)
    };
    // Two groups swap places, a third comes and goes. A share falls from 1 to 0 over a difference in distance of 0.05 to
    // 0.15, which a step changes by 0.002: the share changes by at most 0.04.
    for step in 0..1000 {
        let at = |step: i32| [f64::from(step) * 1e-3, 1.0 - f64::from(step) * 1e-3, 0.4, 0.45];
        let sum: f64 = (0..4).map(|group| share(&at(step), group)).sum();
        assert!((sum - 1.0).abs() < 1e-12, "step {step}: {sum}");
        for group in 0..4 {
            let jump = (share(&at(step), group) - share(&at(step + 1), group)).abs();
            assert!(jump < 0.05, "group {group} jumps by {jump} at step {step}");
        }
    }
}

#[test]
fn weights_of_patch_grids_add_up_and_change_continuously() {
    for (num_grids, group) in [(1, 0), (2, 0), (2, 1), (4, 1)] {
        let weight = |grid: usize, share: f64| grid_weight(grid, num_grids, group, share);
        for share in (0..1000).map(|step| f64::from(step) * 1e-3) {
            let sum: f32 = (0..num_grids).map(|grid| weight(grid, share)).sum();
            assert!((sum - 1.0).abs() < 1e-6, "{num_grids} grids, share {share}: {sum}");
            assert!((0..num_grids).all(|grid| (weight(grid, share) - weight(grid, share + 1e-3)).abs() < 0.01));
        }
        let num_drawn = |share: f64| (0..num_grids).filter(|&grid| weight(grid, share) > 0.0).count();
        assert_eq!([0.5, 1.0].map(num_drawn), [num_grids.div_ceil(2), num_grids]);
    }
    assert_eq!(
        [0, 1].map(|group| grid_weight(0, 2, group, 0.5)),
        [1.0, 0.0],
        "neighbours are drawn on different grids"
    );
}
