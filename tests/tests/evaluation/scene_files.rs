//! Scene files through the command line: encoded, rendered, measured.

use std::process::Command;

use clift_data::{Clip, ClipReader, Split, even_views, open_dataset};
use clift_model::{SelectionPreset, TokenKind, psnr};
use clift_scene::{Scene, TokenCoding, TokenFormat};
use clift_train::{Config, read_config};
use serde_json::json;

use crate::support::{
    BINARY, LONGER, Place, STAGE_1, Shared, WHOLE, files, finish, list, number, point, signal, start, wait_until,
};

/// [`WHOLE`] with camera-relative attention.
static RELATIVE: Shared = Shared::new("run", &["model.camera_encoding=\"gta\""]);

const KEY: &str = "synthetic-0-test-00000";
/// Encodes this scene of the run `run`.
const ENCODE: &str = "encode DIR/run --scene synthetic-0-test-00000 --out";

/// The first test scene with the views that `clift eval` gives it, or another target; the poses of the targets are written.
fn first_clip(place: &Place, target: Option<usize>) -> Clip {
    let config: Config = read_config(&place.at("run/config.toml"), &[]).expect("a run's config").0;
    let source = open_dataset(&config.data, Split::Test, &mut |_, _| ()).expect("the run's rooms").source;
    let mut views = even_views(8, config.eval.num_context, config.eval.num_targets).expect("enough frames");
    assert_eq!(views.context, [0, 7]);
    views.target = target.map_or(views.target, |frame| vec![frame]);
    let cameras = source.cameras(0).expect("cameras");
    let poses = views.target.iter().map(|&frame| {
        let rows: Vec<Vec<f64>> = cameras[frame].c2w.to_matrix_f64().chunks(4).map(<[f64]>::to_vec).collect();
        json!({"c2w": rows})
    });
    place.write("poses.json", json!({"poses": poses.collect::<Vec<_>>()}).to_string());
    ClipReader { source, options: config.data.clip_options() }.read(0, &views).expect("readable")
}

/// PSNR of every target of a clip, rendered from a scene file.
fn rendered(place: &Place, words: &str, clip: &Clip) -> Vec<f64> {
    let flags = "--path DIR/poses.json --precision f32 --force -o DIR/frames";
    place.clift(&format!("render DIR/{words} {flags}")).ok();
    let unit = |values: &[u8]| values.iter().map(|&value| f32::from(value) / 255.0).collect::<Vec<_>>();
    let truths = clip.target.images.chunks(clip.target.height * clip.target.width * 3).enumerate();
    let psnr = |(view, truth): (usize, &[u8])| {
        let picture = image::open(place.at(&format!("frames/frame-{view:05}.png"))).expect("a frame").into_rgb8();
        psnr(&unit(picture.as_raw()), &unit(truth)).expect("finite")
    };
    truths.map(psnr).collect()
}

/// PSNR that an evaluation wrote for the first scene's condensed tokens, all of them or some.
fn evaluated(place: &Place, eval: &str, format: TokenFormat, [stored, rendered]: [usize; 2]) -> Vec<f64> {
    let [stored, rendered] = [stored, rendered].map(|count| count.to_string());
    let text = place.text(&format!("{eval}/views.csv"));
    let rows = text.lines().map(|line| line.split(',').collect::<Vec<_>>());
    let is_it =
        |row: &Vec<&str>| row[0] == KEY && row[2..5] == ["clift", &stored, &rendered] && row[11] == format.name();
    rows.filter(is_it).map(|row| row[5].parse().expect("a number")).collect()
}

#[track_caller]
fn assert_close(psnr: &[f64], expected: &[f64], most: f64) {
    assert_eq!(psnr.len(), expected.len());
    assert!(psnr.iter().zip(expected).all(|(a, b)| (a - b).abs() <= most), "{psnr:?} dB, not {expected:?}");
}

/// Difference of a frame in 8 bits: half a level is at most this many dB here.
const ROUNDING: f64 = 0.02;

#[test]
fn scene_files_reproduce_the_evaluation() {
    let place = Place::with(&LONGER);
    let clip = first_clip(&place, None);
    place.eval("run --format f32,f16 --out DIR/formats").ok();
    let points = place.points("formats");
    for (count, format) in [4, 8].into_iter().flat_map(|count| TokenFormat::ALL.map(|format| (count, format))) {
        let storage = format.name();
        let flags = format!("--context 0,7 --stored-tokens {count} --format {storage} --force");
        let ran = place.clift(&format!("{ENCODE} DIR/room.clift {flags}")).ok();
        ran.prints(&format!("{count} of 8 tokens (clift, {storage})"));

        // The file's size is that of the formula, and of the evaluation's summary.
        let (scene, found) = Scene::read(&place.at("room.clift")).unwrap();
        assert_eq!((scene.num_tokens(), scene.kind, found), (count, TokenKind::Clift, TokenCoding::Plain(format)));
        assert_eq!(scene.context_frames, [0, 7]);
        let bytes = place.bytes("room.clift").len() as u64;
        assert_eq!(bytes, 8 + 2048 + 136 + 164 * 2 + 140 + 4 * 2 + (count * (28 + format.bytes_per_token(16))) as u64);
        assert_eq!(bytes, scene.file_bytes(format));
        let of_format = points.iter().filter(|point| point["tokens"] == storage);
        assert_eq!(point(of_format, "clift", count)["scene_bytes"], bytes);

        let [of_format, exact] =
            [format, TokenFormat::F32].map(|format| evaluated(&place, "formats", format, [count; 2]));
        assert_close(&rendered(&place, "room.clift", &clip), &of_format, ROUNDING);
        assert_close(&of_format, &exact, 0.005);
    }
}

#[test]
fn evaluation_of_selected_tokens_equals_rendering_the_file() {
    for (run, presets) in [(&LONGER, SelectionPreset::ALL), (&RELATIVE, &[SelectionPreset::Paper])] {
        let place = Place::with(run);
        let clip = first_clip(&place, None);
        place.clift(&format!("{ENCODE} DIR/room.clift --context 0,7 --stored-tokens 4 --format f32")).ok();
        for name in presets.iter().map(|preset| preset.name()) {
            place.eval(&format!("run --format f32 --render 3,1/2 --selection {name} --out DIR/{name}")).ok();
            for count in [2, 3] {
                let words = format!("room.clift --render {count} --selection {name}");
                let expected = evaluated(&place, name, TokenFormat::F32, [4, count]);
                assert_close(&rendered(&place, &words, &clip), &expected, ROUNDING);
            }
        }
        for count in ["8", "1.0", "400"] {
            place.eval(&format!("run --render {count}")).fails_with(2, &["`eval.render`", "less than 8"]);
        }
    }
}

#[test]
fn paths_render_to_frames_and_animation_by_count() {
    let place = Place::with(&WHOLE);
    place.clift(&format!("{ENCODE} DIR/room.clift --stored-tokens 1.0 --format f16")).ok();
    for (out, size, flags, num_render_tokens) in [
        ("all", (16, 16), "--path interpolate", 8),
        ("some", (16, 16), "--path interpolate --render 3 --precision f32", 3),
        ("global", (16, 16), "--path orbit --render 1/2 --selection global --patch-grids 4", 4),
        ("large", (48, 32), "--path orbit --size 48x32", 8),
        ("small", (7, 15), "--path orbit --size 7x15 --render 3", 3),
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
        assert_eq!((&report["num_frames"], &report["num_render_tokens"]), (&10.into(), &num_render_tokens.into()));
        let tokens = &report["tokens"];
        assert_eq!(tokens.is_null(), num_render_tokens == 8, "{report}");
        assert!(tokens.as_array().into_iter().flatten().all(|frame| list(frame).len() == num_render_tokens));
        assert_eq!(report["patch_grids"], if out == "global" { 4 } else { 1 });
        assert_eq!(number(&report, "select_s") > 0.0, num_render_tokens < 8, "{report}");
    }
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
    let expected = rendered(&place, "room.clift", &first_clip(&place, Some(3)));
    assert_close(&decibels[..1], &expected, ROUNDING + 0.005);
    let warning = "warning: the rendering of frame ";
    assert!(decibels[0] > decibels[1] && !ran.stderr.contains(warning), "{check}");
    // The frames beside it are better copies than sixty steps of training.
    encode("--context 4,6")
        .prints("check: frame 5, not a context: ")
        .notes(&format!("{warning}5 is worse than a copy"));
    let ran = encode("--context 0,1,2,3,4,5,6,7").prints("check: 8 context views rendered at ");
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

    // Without stage 2, tokens are those nearest to the cluster centres.
    let ran = one("--stored-tokens 8 --context 0,7").ok().prints("8 of 8 tokens (kmeans, f16)");
    ran.prints("check: frame 3, not a context: ");
    one("--stored-tokens 1/2").ok().prints("4 of 8 tokens");
    let ran = place.clift("render DIR/room.clift --out DIR/out --path orbit --frames 2").ok();
    ran.prints("2 frames of 16 x 16");

    // Chunks of the same kind as the run's or not: any folder of them, either half, whole or by its index.
    let mini = "REPO/data-fixtures/re10k-mini";
    encode(mini).ok().prints("scene 00000000000000b1, 8 views in 5 groups of 16 x 16");
    encode(&format!("{mini}/test")).ok().prints("scene 00000000000000b1");
    let second = encode(&format!("{mini} --split train --scene 00000000000000a2")).ok();
    second.prints("scene 00000000000000a2");
    encode(&format!("{mini} --set data.width=24"))
        .fails_with(2, &["--set data.width: ", "choose the size of frames with `clift render --size`"]);
    encode("DIR/run").fails_with(2, &["no scenes found: expected index.json with chunks, "]);
}
