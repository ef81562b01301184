//! Scenes in other layouts than chunks, through the command line.

use std::process::Command;

use crate::support::{BINARY, Place, Ran, copy_folder, finish, list, repository, start};
use crate::viewer::tab::{Tab, Viewer};

/// Keys that put the micro run on six frames of 32 x 18.
fn data(source: &str, layout: &str, more: &str) -> String {
    let root = repository("data-fixtures/layouts").join(layout);
    format!(
        "data={{source='{source}', root='{}', width=16, height=16, {more} views={{min_context=2, max_context=2, \
         min_gap=[3, 3], max_gap=[5, 5], warm_up_steps=0, num_targets=2}}}}",
        root.display()
    )
}

#[test]
fn captures_train_and_render_and_name_missing_frames() {
    let place = Place::new();
    let ran = place.train("run", &[&data("auto", "capture", ""), "clusters.num_scenes=0", "stage1.steps=300"]).ok();
    ran.notes("train: 1 scene used; 1 frame without an image (./images/99); no test split: 1 of 8 frames");
    let frame = &place.json("run/skipped-train.json")["frames"][0];
    assert_eq!((&frame["key"], &frame["frame"]), (&"attic".into(), &"./images/99".into()));
    let encode = "encode DIR/run REPO/data-fixtures/layouts/colmap_txt/attic -o DIR/attic.clift --stored-tokens 1.0 --format f32";
    let ran = place.clift(encode).ok().prints("scene attic, 6 views in 5 groups of 16 x 16");
    let ran = ran.notes("fog, below 23 dB or worse than the mean image, in ");
    let psnr = |ran: Ran| ran.stdout.split("6 context views rendered at ").nth(1).unwrap()[..5].parse::<f64>().unwrap();
    let (before, after) = (psnr(ran), psnr(place.clift(&format!("{encode} --force --refine 100")).ok()));
    assert!(after > before + 0.2, "the tokens are fitted to the photos: {before} dB before, {after} dB after");
    let render = "render DIR/attic.clift --path interpolate --frames 2 -o DIR/frames";
    place.clift(render).ok().prints("2 frames of 16 x 16");

    // The viewer takes the contexts of `clift encode`, also of captures too short for an evaluation.
    copy_folder(&repository("data-fixtures/layouts/capture/attic"), &place.at("few"));
    let mut transforms = place.json("few/transforms.json");
    transforms["frames"].as_array_mut().unwrap().truncate(2);
    place.write("few/transforms.json", transforms.to_string());
    let tab = Tab::open(&Viewer::start(&["run", "few"], &place.at("")));
    let frames: Vec<_> = list(&tab.scene["context"]).iter().map(|view| view["frame"].as_u64()).collect();
    assert_eq!(frames, [Some(0), Some(1)]);

    let with_model = |model: &str| {
        let mut command = Command::new(BINARY);
        command.args(["encode", "-o"]).arg(place.at(&format!("{model}.clift")));
        command.arg(repository("data-fixtures/layouts/colmap_txt/attic")).env("CLIFT_MODEL", place.at(model));
        finish(start(&mut command))
    };
    with_model("run").ok().prints("scene attic, 6 views in 5 groups of 16 x 16").notes("model: ");
    with_model("none").fails_with(2, &["/none: no such file or folder"]);
}

#[test]
fn the_program_alone_encodes_photos_renders_and_trains() {
    let place = Place::new();
    place.clift("data synth DIR/scene --look real --scenes 1 --frames 16 --size 192x192").ok();
    let alone = |words: &str| {
        let mut command = Command::new(BINARY);
        command.args(words.split(' ')).env_remove("CLIFT_MODEL").current_dir(place.at(""));
        finish(start(&mut command)).ok()
    };
    let ran = alone("encode scene --hold-out 8 -o scene.clift");
    let ran =
        ran.prints("14 of 16 views in 9 groups of 128 x 128").prints("(clift, coded").notes("model: models/rooms");
    // Renderings of the frames beside the contexts are better than copies of the nearest.
    ran.prints("check: 2 frames held out: ").prints("; 2 rendered better");
    alone("render scene.clift --path orbit --frames 2 -o orbit")
        .prints("animation, for a browser: orbit/animation.png");
    let ran = alone(
        "train configs/capture.toml --only stage1 --set data.source=auto --set data.root=scene --set run_dir=run \
         --set stage1.steps=1 --set stage1.batch_size=1 --set stage1.accumulate=1 --set eval.num_validation_scenes=1",
    );
    ran.notes("config: configs/capture.toml, which ships with clift").notes(" parameters from ").notes("/rooms-");
    // Names of the repository, not of files beside the program.
    alone("plan configs/tiny.toml").prints("stage1");
}

#[test]
fn dl3dv_training_requires_a_test_scene_list() {
    let place = Place::new();
    for source in ["dl3dv", "auto", "captures"] {
        place.train("run", &[&data(source, "dl3dv", "")]).fails_with(
            2,
            &["`data.files.test_scenes` = missing: the folders also hold the benchmark scenes of DL3DV"],
        );
    }
    place.write("none.txt", "");
    let files = format!("files={{test_scenes='{}'}},", place.at("none.txt").display());
    let ran = place.train("run --only stage1", &[&data("dl3dv", "dl3dv", &files)]).ok();
    ran.notes("no test split: 1 of 8 frames (0, 8, ..) is held out of training");
    let files = format!("{files} filters={{min_frames=9}},");
    place
        .train("other", &[&data("auto", "dl3dv", &files)])
        .fails_with(1, &["0 of 1 scene used; 1 shorter than the 9 frames of data.filters.min_frames"]);
}
