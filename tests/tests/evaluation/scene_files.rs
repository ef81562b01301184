//! Scene files through the command line: encoded, rendered, measured.

use std::process::Command;

use clift_data::{Clip, ClipReader, Split, ViewIndices, even_views, open_dataset};
use clift_eval::Canvas;
use clift_model::{Precision, SelectionPreset, TokenKind, psnr, ssim};
use clift_scene::{Scene, SceneRenderer, TokenCoding, TokenFormat, load_renderer};
use clift_train::{Config, read_config};
use serde_json::{Value, json};

use crate::support::{
    BINARY, LONGER, Place, STAGE_1, Shared, WHOLE, files, finish, list, number, signal, start, wait_until,
};

/// [`WHOLE`] with camera-relative attention.
static RELATIVE: Shared = Shared::new("run", &["model.camera_encoding=\"gta\""]);

const KEY: &str = "synthetic-0-test-00000";
/// Encodes this scene of the run `run`.
const ENCODE: &str = "encode DIR/run --scene synthetic-0-test-00000 --out";

/// The first test scene with the views that `clift eval` gives it.
fn first_clip(place: &Place) -> (Clip, ClipReader) {
    let config: Config = read_config(&place.at("run/config.toml"), &[]).expect("a run's config").0;
    let source = open_dataset(&config.data, Split::Test, &mut |_, _| ()).expect("the run's rooms").source;
    let reader = ClipReader { source, options: config.data.clip_options() };
    let views = even_views(8, config.eval.num_context, config.eval.num_targets).expect("enough frames");
    assert_eq!(views.context, [0, 7]);
    (reader.read(0, &views).expect("readable"), reader)
}

/// PSNR and SSIM of every target view of a clip.
fn measure(clip: &Clip, pictures: &[Vec<f32>]) -> Vec<(f64, f64)> {
    let (height, width) = (clip.target.height, clip.target.width);
    let truths = clip.target.images.chunks(height * width * 3);
    assert_eq!(pictures.len(), clip.target.num_views());
    let measure = |(pixels, truth): (&Vec<f32>, &[u8])| {
        let truth: Vec<f32> = truth.iter().map(|&value| f32::from(value) / 255.0).collect();
        let (psnr, ssim) = (psnr(pixels, &truth), ssim(pixels, &truth, height, width));
        (psnr.expect("finite"), ssim.expect("large enough"))
    };
    pictures.iter().zip(truths).map(measure).collect()
}

/// PSNR and SSIM that an evaluation wrote for the first scene's condensed tokens, all of them or some.
fn evaluated(
    place: &Place,
    eval: &str,
    format: TokenFormat,
    num_tokens: usize,
    num_render_tokens: usize,
) -> Vec<(f64, f64)> {
    let [stored, rendered] = [num_tokens, num_render_tokens].map(|count| count.to_string());
    let text = place.text(&format!("{eval}/views.csv"));
    let rows = text.lines().map(|line| line.split(',').collect::<Vec<_>>());
    let is_it =
        |row: &Vec<&str>| row[0] == KEY && row[2..5] == ["clift", &stored, &rendered] && row[11] == format.name();
    let rows = rows.filter(is_it);
    rows.map(|row| (row[5].parse().expect("a number"), row[6].parse().expect("a number"))).collect()
}

fn open(place: &Place, name: &str, preset: SelectionPreset) -> SceneRenderer {
    let (scene, _) = Scene::read(&place.at(name)).expect("a scene");
    let device = burn::tensor::Device::flex();
    let renderer = load_renderer(&scene, &place.at("run/stage2/model.safetensors"), &device).expect("its renderer");
    SceneRenderer::new(&scene, renderer, preset.rules(), &device).expect("its tokens")
}

/// Renders a clip's targets, each view from `num_render_tokens` tokens.
fn drawn(mut scene: SceneRenderer, clip: &Clip, num_render_tokens: usize) -> Vec<Vec<f32>> {
    let frames =
        scene.render(&clip.target.cameras, clip.target.height, clip.target.width, num_render_tokens).expect("draws");
    frames.into_iter().map(|frame| frame.pixels).collect()
}

#[test]
fn scene_files_reproduce_the_evaluation() {
    let place = Place::with(&LONGER);
    let (clip, reader) = first_clip(&place);
    let cameras = reader.source.cameras(0).expect("cameras");
    let poses = clip.target.frame_index.iter().map(|&frame| {
        let rows: Vec<Vec<f64>> = cameras[frame].c2w.to_matrix_f64().chunks(4).map(<[f64]>::to_vec).collect();
        json!({"c2w": rows})
    });
    place.write("poses.json", json!({"poses": poses.collect::<Vec<_>>()}).to_string());
    place.eval("run --format f32,f16,int8 --out DIR/formats").ok();
    let points = place.points("formats");
    for (count, format) in [4, 8].into_iter().flat_map(|count| TokenFormat::ALL.map(|format| (count, format))) {
        let storage = format.name();
        let name = format!("{count}-{storage}.clift");
        let flags = format!("--context 0,7 --stored-tokens {count} --format {storage}");
        let ran = place.clift(&format!("{ENCODE} DIR/{name} {flags}")).ok();
        ran.prints(&format!("{count} of 8 tokens (clift, {storage})"));

        // The file's size is that of the formula, and of the evaluation's summary.
        let (scene, found) = Scene::read(&place.at(&name)).unwrap();
        assert_eq!((scene.num_tokens(), scene.kind, found), (count, TokenKind::Clift, TokenCoding::Plain(format)));
        assert_eq!(scene.context_frames, [0, 7]);
        let bytes = place.bytes(&name).len() as u64;
        assert_eq!(bytes, 8 + 2048 + 136 + 164 * 2 + 140 + 4 * 2 + (count * (28 + format.bytes_per_token(16))) as u64);
        assert_eq!(bytes, scene.file_bytes(format));
        let is_it = |point: &&Value| {
            point["method"] == "clift" && point["tokens"] == storage && point["num_storage_tokens"] == count
        };
        assert_eq!(points.iter().find(is_it).expect("measured")["scene_bytes"], bytes);

        // Images from the file equal those of the evaluation in memory to the last digit, at every format.
        let from_file = measure(&clip, &drawn(open(&place, &name, SelectionPreset::Paper), &clip, count));
        assert_eq!(from_file, evaluated(&place, "formats", format, count, count), "{name}");
        let exact = evaluated(&place, "formats", TokenFormat::F32, count, count);
        let loss_db = match format {
            TokenFormat::F32 => 0.0,
            TokenFormat::F16 => 0.005,
            TokenFormat::Int8 => 0.05,
        };
        for ((psnr, _), (exact, _)) in from_file.iter().zip(&exact) {
            assert!((psnr - exact).abs() <= loss_db, "{name}: {psnr} dB against {exact}");
        }

        // The command renders the same images, rounded to 8 bits: half a level is at most 0.02 dB here.
        let out = format!("{count}-{storage}");
        place.clift(&format!("render DIR/{name} --out DIR/{out} --path DIR/poses.json --precision f32")).ok();
        let pictures = (0..clip.target.num_views()).map(|view| {
            let picture = image::open(place.at(&format!("{out}/frame-{view:05}.png"))).unwrap().into_rgb8();
            picture.into_raw().iter().map(|&value| f32::from(value) / 255.0).collect()
        });
        let pictures: Vec<Vec<f32>> = pictures.collect();
        for ((psnr, _), (exact, _)) in measure(&clip, &pictures).iter().zip(&from_file) {
            assert!((psnr - exact).abs() < 0.02, "{name}: {psnr} dB in the file, {exact} drawn");
        }
    }
}

#[test]
fn evaluation_of_selected_tokens_equals_rendering_the_file() {
    for (run, presets) in [(&LONGER, SelectionPreset::ALL), (&RELATIVE, &[SelectionPreset::Paper])] {
        let place = Place::with(run);
        let (clip, _) = first_clip(&place);
        place.clift(&format!("{ENCODE} DIR/room.clift --context 0,7 --stored-tokens 4 --format f32")).ok();
        for &preset in presets {
            let name = preset.name();
            place.eval(&format!("run --format f32 --render 3,1/2 --selection {name} --out DIR/{name}")).ok();
            for count in [2, 3] {
                let from_file = measure(&clip, &drawn(open(&place, "room.clift", preset), &clip, count));
                assert_eq!(from_file, evaluated(&place, name, TokenFormat::F32, 4, count), "{name}, {count}");
            }
        }
    }
}

#[test]
fn camera_relative_networks_have_no_published_form() {
    let place = Place::with(&RELATIVE);
    let expected = "`model.camera_encoding` = gta: published networks have plain attention";
    place.clift("export DIR/run --format pytorch -o DIR/run.ckpt").fails_with(2, &[expected]);
}

#[test]
fn paths_render_to_frames_and_animation_by_count() {
    let place = Place::with(&WHOLE);
    place.clift(&format!("{ENCODE} DIR/room.clift --stored-tokens 1.0 --format f16")).ok();
    let (scene, storage) = Scene::read(&place.at("room.clift")).unwrap();
    assert_eq!((scene.num_tokens(), storage), (8, TokenCoding::F16));
    assert_eq!(scene.context_frames.len(), 2, "as many contexts as in training");
    for (out, size, flags, num_render_tokens) in [
        ("all", (16, 16), "--path interpolate", 8),
        ("some", (16, 16), "--path interpolate --render 3 --precision f32", 3),
        ("global", (16, 16), "--path orbit --render 1/2 --selection global --patch-grids 4", 4),
        ("large", (48, 32), "--path orbit --size 48x32", 8),
        ("small", (7, 15), "--path orbit --size 7x15 --render 3", 3),
        ("in-time", (16, 16), "--path orbit --budget-ms 60000", 8),
    ] {
        let ran = place.clift(&format!("render DIR/room.clift --out DIR/{out} {flags} --frames 10 --fps 12")).ok();
        let ran =
            ran.prints(&format!("10 frames of {} x {}, each from {num_render_tokens} of 8 tokens", size.0, size.1));
        let warning = "warning: the network was trained on images of 16 x 16; frames of 48 x 32 show no more detail";
        assert_eq!(ran.stderr.contains(warning), out == "large", "{}", ran.stderr);
        let mut expected: Vec<String> = (0..10).map(|frame| format!("frame-{frame:05}.png")).collect();
        expected.insert(0, "animation.png".into());
        expected.push("render.json".into());
        assert_eq!(place.names(out), expected);
        for name in &expected[..11] {
            assert_eq!(image::image_dimensions(place.at(out).join(name)).unwrap(), size, "{out}/{name}");
        }
        let report = place.json(&format!("{out}/render.json"));
        let precision =
            if flags.contains("f32") { Precision::F32 } else { Precision::for_images(&burn::tensor::Device::flex()) };
        assert_eq!(report["precision"], precision.as_str());
        assert_eq!((&report["num_frames"], &report["num_render_tokens"]), (&10.into(), &num_render_tokens.into()));
        let tokens = &report["tokens"];
        assert_eq!(tokens.is_null(), num_render_tokens == 8, "{report}");
        for frame in tokens.as_array().into_iter().flatten() {
            let ids: Vec<u64> = list(frame).iter().map(|id| id.as_u64().expect("an index")).collect();
            assert!(ids.len() == num_render_tokens && ids.is_sorted_by(|a, b| a < b) && ids.iter().all(|id| *id < 8));
        }
        assert_eq!(report["patch_grids"], if out == "global" { 4 } else { 1 });
        assert_eq!(report["calibration"].is_array(), out == "in-time", "{report}");
        assert_eq!(number(&report, "select_s") > 0.0, num_render_tokens < 8, "{report}");
        let selection = match out {
            "some" | "small" => "scaled".into(),
            "global" => "global".into(),
            _ => Value::Null,
        };
        let path = flags.split(' ').nth(1);
        assert_eq!((report["path"].as_str(), &report["selection"]), (path, &selection));
    }
    // The first frame through the contexts is the first context's.
    let mut viewer = open(&place, "room.clift", SelectionPreset::Paper);
    let first = viewer.render(&scene.context[..1], 16, 16, 8).unwrap().remove(0);
    let first = Canvas::from_unit(&first.pixels, 16, 16).unwrap();
    let written = image::open(place.at("all/frame-00000.png")).unwrap().into_rgb8();
    let difference = first.as_rgb8().iter().zip(written.as_raw()).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(difference <= Some(1), "rounding alone differs: {difference:?}");
    assert_ne!(place.bytes("all/frame-00000.png"), place.bytes("some/frame-00000.png"));
    assert_ne!(place.bytes("all/frame-00000.png"), place.bytes("all/frame-00009.png"));
}

#[test]
fn what_cannot_be_drawn_says_what_to_do() {
    let place = Place::with(&WHOLE);
    place.train("other --only stage1", &["seed=1"]).ok();
    place.clift(&format!("{ENCODE} DIR/room.clift --format f16")).ok();
    let render = |flags: &str| place.clift(&format!("render DIR/room.clift --out DIR/out {flags}"));
    let orbit = "--path orbit --frames 2";
    let no_path = "--path interpolated: no such file; write interpolate, orbit or";
    render("--path interpolated").fails_with(2, &[no_path]);
    for (flags, expected) in [
        ("--budget-ms 0.0001", "the fastest frame takes "),
        ("--size 4000x8", "the field of view takes more than 64 images of the trained size"),
        ("--size 1000000x8", "--size 1000000x8: write at most 16384 pixels per side"),
        ("--size 17179869184x17179869184", "--size 17179869184x17179869184: write at most 16384 pixels per side"),
        ("--render 9", "a scene has 2 tokens"),
        ("--model DIR/other/stage1/model.safetensors", "the scene was made for the renderer "),
    ] {
        render(&format!("{orbit} {flags}")).fails_with(2, &[expected]);
    }
    // The second pose is an invalid camera: the command also writes no frame of the first.
    let pose = json!({"c2w": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]});
    let far = json!({"c2w": [[1, 0, 0, 1e9], [0, 1, 0, 0], [0, 0, 1, 0]]});
    place.write("poses.json", json!({"poses": [pose, far]}).to_string());
    render("--path DIR/poses.json").fails_with(1, &["pose 1: bad camera: the camera is "]);
    let counted = "a file of poses determines the number of frames";
    render("--path DIR/poses.json --frames 3").fails_with(2, &[counted]);
    assert!(!place.at("out").exists(), "nothing is left of what was refused");
    place.write("out/notes.txt", "");
    render(&format!("{orbit} --force")).fails_with(2, &["is not empty and holds no frames; choose another folder"]);
    std::fs::remove_file(place.at("out/notes.txt")).unwrap();
    std::fs::rename(place.at("run"), place.at("moved")).unwrap();
    render(orbit).fails_with(2, &["the weights of the scene are not found at ", "; set --model RUN"]);
    render(&format!("{orbit} --model DIR/moved")).ok();
    let before = files(&place.at("out"));
    render(&format!("{orbit} --model DIR/moved")).fails_with(2, &["holds frames; replace them with --force"]);
    assert!(files(&place.at("out")) == before);
    render("--path orbit --frames 1 --model DIR/moved --force").ok();
    assert_eq!(place.names("out"), ["animation.png", "frame-00000.png", "render.json"]);

    place.truncate("room.clift");
    let again = |scene: &str| place.clift(&format!("render DIR/{scene} --out DIR/again {orbit}"));
    again("room.clift").fails_with(1, &["cannot use the scene: the file is truncated", "copy it again"]);
    again("moved/stage2/model.safetensors").fails_with(1, &["its header lacks the scene format"]);
}

#[cfg(unix)]
#[test]
fn a_path_that_is_interrupted_leaves_nothing_behind() {
    let place = Place::with(&WHOLE);
    place.clift(&format!("{ENCODE} DIR/room.clift")).ok();
    let mut child = place.start("render DIR/room.clift --out DIR/out --path orbit --frames 100000");
    wait_until(&mut child, "a frame", || {
        let mut items = std::fs::read_dir(place.at("out")).into_iter().flatten().flatten();
        items.any(|item| std::fs::read_dir(item.path()).is_ok_and(|frames| frames.count() > 3))
    });
    signal(&child, "-INT");
    finish(child).fails_with(130, &["error: interrupted while rendering frame ", "no output files were written"]);
    assert!(!place.at("out").exists());
}

#[test]
fn scene_files_overwrite_only_scene_files() {
    let place = Place::with(&STAGE_1);
    let encode = |words: &str| place.clift(&format!("{ENCODE} DIR/{words}"));
    let weights = place.bytes("run/stage1/model.safetensors");
    encode("run/stage1/model.safetensors")
        .fails_with(2, &["the existing file is not a scene, and only scenes are overwritten"]);
    assert_eq!(place.bytes("run/stage1/model.safetensors"), weights);
    encode("no/room.clift").fails_with(2, &["no folder "]);
    encode("room.clift").ok();
    encode("room.clift --stored-tokens 8").fails_with(2, &["room.clift exists; replace it with --force"]);
    encode("room.clift --stored-tokens 8 --force").ok();
    assert_eq!(Scene::read(&place.at("room.clift")).unwrap().0.num_tokens(), 8);
    // Another number of heads fits the same weights and would change every image.
    for change in ["model.num_heads=1", "model={num_heads=1}"] {
        encode(&format!("heads.clift --set {change}"))
            .fails_with(2, &["--set model: the weights were trained with another network"]);
    }
}

#[test]
fn encode_compares_a_frame_that_is_no_context() {
    let place = Place::with(&LONGER);
    let encode = |flags: &str| {
        place.clift(&format!("{ENCODE} DIR/room.clift --format f32 --stored-tokens 8 {flags} --force")).ok()
    };
    let ran = encode("--context 0,7");
    let check = ran.stdout.lines().find(|line| line.starts_with("check: frame 3, not a context: ")).expect("a check");
    let decibels: Vec<f64> = check.split(' ').filter_map(|word| word.parse().ok()).collect();
    // The frame of the scene file, rendered as `clift eval` does.
    let (mut clip, reader) = first_clip(&place);
    clip.target = reader.read(0, &ViewIndices { context: vec![0, 7], target: vec![3] }).unwrap().target;
    let rendered = drawn(open(&place, "room.clift", SelectionPreset::Paper), &clip, 8);
    let expected = measure(&clip, &rendered)[0].0;
    assert!((decibels[0] - expected).abs() < 0.006, "{check}, expected {expected}");
    let warning = "warning: the rendering of frame ";
    assert!(decibels[0] > decibels[1] && !ran.stderr.contains(warning), "{check}");
    // The frames beside it are better copies than sixty steps of training.
    encode("--context 4,6")
        .prints("check: frame 5, not a context: ")
        .notes(&format!("{warning}5 is worse than a copy"));
    let ran = encode("--context 0,1,2,3,4,5,6,7").prints("check: the context views are rendered at ");
    assert!(!ran.stdout.contains("not a context"), "{}", ran.stdout);
}

#[test]
fn scene_and_run_move_together() {
    let place = Place::new();
    place.copy(&STAGE_1, "home/run");
    std::fs::create_dir_all(place.at("home/scenes")).unwrap();
    let clift = |folder: &str, words: &str| {
        finish(start(Command::new(BINARY).current_dir(place.at(folder)).args(words.split(' '))))
    };
    clift("home", &format!("encode run --scene {KEY} -o scenes/room.clift")).ok();
    assert_eq!(Scene::read(&place.at("home/scenes/room.clift")).unwrap().0.model_path, "../run");
    std::fs::rename(place.at("home"), place.at("moved")).unwrap();
    clift("", "render moved/scenes/room.clift --path orbit --frames 2 --out out").ok();
    clift("moved/scenes", "render room.clift --path orbit --frames 2 --out out").ok();
}

#[test]
fn encode_chooses_scenes_by_key_context_and_count() {
    let place = Place::with(&STAGE_1);
    let encode = |words: &str| place.clift(&format!("encode DIR/run --out DIR/room.clift --force {words}"));
    encode("").fails_with(2, &["scenes; choose one with --scene: synthetic-0-test-00000, "]);
    encode("--scene attic").fails_with(2, &["no scene attic; the "]);
    let one = |flags: &str| encode(&format!("--scene {KEY} {flags}"));
    one("--context 0,8").fails_with(2, &["`--context` = 0,8: there is no frame 8; the scene has frames 0 to 7"]);
    one("--stored-tokens 9").fails_with(2, &["a scene has 8 tokens"]);

    // Without stage 2, tokens are those nearest to the cluster centres; all of them leave no variance within clusters.
    let ran = one("--stored-tokens 8 --context 0,7").ok().prints("8 of 8 tokens (kmeans, f16)");
    ran.prints("     8  0.0000\n").prints("check: frame 3, not a context: ");
    one("--stored-tokens 1/2 --save-clusters DIR/clusters.json").ok().prints("4 of 8 tokens");
    let clusters = place.json("clusters.json");
    assert_eq!((list(&clusters["assignment"]).len(), list(&clusters["centroids"]).len()), (8, 4));
    assert_eq!((&clusters["rows"], &clusters["columns"]), (&2.into(), &2.into()));
    // A centroid is a token of its own cluster, and a token of the scene file.
    let centroids: Vec<u32> = list(&clusters["centroids"]).iter().map(|id| id.as_u64().unwrap() as u32).collect();
    assert_eq!(centroids, Scene::read(&place.at("room.clift")).unwrap().0.token_ids);
    for (cluster, &token) in centroids.iter().enumerate() {
        assert_eq!(clusters["assignment"][token as usize], cluster);
    }
    let ran = place.clift("render DIR/room.clift --out DIR/out --path orbit --frames 2").ok();
    ran.prints("2 frames of 16 x 16");

    // Chunks of the same kind as the run's or not: any folder of them, either half, whole or by its index.
    let mini = "REPO/data-fixtures/re10k-mini";
    encode(mini).ok().prints("scene 00000000000000b1, 8 views in 5 groups of 16 x 16");
    encode(&format!("{mini}/test")).ok().prints("scene 00000000000000b1");
    let second = encode(&format!("{mini} --split train --scene 00000000000000a2")).ok();
    second.prints("scene 00000000000000a2");
    // Images of 64 x 36: another crop keeps the pixels per angle, another number of rows does not.
    let sized =
        |width: usize, height: usize| encode(&format!("{mini} --set data.width={width} --set data.height={height}"));
    let warning = "warning: the network was trained on images of 16 x 16; images of 24 x 16 may lose quality";
    sized(24, 16).ok().prints("8 views in 5 groups of 24 x 16").notes(warning);
    for (size, times) in [(32, "2.00"), (8, "0.50")] {
        let images =
            format!("at {size} x {size} pixels, images of 64 x 36 have {times} times as many pixels per angle");
        sized(size, size).fails_with(2, &[&images, "write at most 24 x 16, and choose the size of frames with"]);
    }
    encode("DIR/run").fails_with(2, &["no scenes found: expected index.json with chunks, "]);

    let by = |model: &str| place.clift(&format!("encode DIR/{model} {mini} -o DIR/from-file.clift --force"));
    by("run/stage1/model.safetensors").ok();
    let file = place.at("run/stage1/model.safetensors");
    assert_eq!(Scene::read(&place.at("from-file.clift")).unwrap().0.model_path, file.display().to_string());
    by("run/stage1").ok();
    std::fs::copy(&file, place.at("alone.safetensors")).unwrap();
    by("alone.safetensors").fails_with(2, &["no config.toml next to"]);
}
