//! Encoding to a scene file, and rendering from it.

use std::path::Path;

use burn::module::Module;
use clift_core::{Camera, Pose};
use clift_data::{ClipReader, DataConfig, Split, SyntheticConfig, ViewSampler, open_dataset};
use clift_model::{CliftVariant, SelectionPreset, TokenCount, TrainedModel, save_weights};
use clift_scene::{ContextChoice, EncodeOptions, Scene, SceneRenderer, TokenFormat, encode, load_renderer};
use clift_train::Config;

use crate::cpu;
use crate::place::{Place, SIZE, network};
use crate::table::{Case, Tolerance, Values};

const IMAGES: Tolerance = Tolerance::forward(1e-5, "the renderer's; the same file for both devices");

pub const CASES: &[Case] = &[
    Tolerance::forward(5e-5, "encoder, clusters and condenser one after the other; the chosen patches are the same")
        .case("scene: capture to `.clift` file", |place| {
            let folder = tempfile::tempdir().expect("a folder");
            let scene = encode_room(place, folder.path(), TokenFormat::F32);
            let ids = scene.token_ids.iter().copied().map(f64::from).collect();
            let tokens = scene.tokens.iter().copied().map(f64::from).collect();
            Values { forward: vec![("patches".into(), ids), ("tokens".into(), tokens)], ..Values::default() }
        }),
    IMAGES.case("scene: f32 file to images, all tokens and some", |place| draw(place, TokenFormat::F32)),
    IMAGES
        .because("the same: the host unpacks 16 bits")
        .case("scene: f16 file to images", |place| draw(place, TokenFormat::F16)),
    IMAGES
        .because("the same: the host unpacks 8 bits")
        .case("scene: int8 file to images", |place| draw(place, TokenFormat::Int8)),
];

/// Stored tokens of the room's 12. One cluster is a pair, whose centroid once depended on rounding.
const STORED: usize = 7;

/// Encodes a synthetic room on the device of `place`, writes the file and reads it back.
fn encode_room(place: &Place, folder: &Path, storage: TokenFormat) -> Scene {
    let [height, width] = SIZE;
    let synthetic = SyntheticConfig {
        num_scenes: 2,
        num_frames: 6,
        height,
        width,
        seed: u64::from(place.is_wrong),
        ..SyntheticConfig::default()
    };
    let views = ViewSampler { min_context: 2, max_context: 2, ..ViewSampler::default() };
    let data = DataConfig { height, width, synthetic, views, ..DataConfig::default() };
    let config = Config { data, model: network(CliftVariant::Paper), ..Config::default() };
    let source = open_dataset(&config.data, Split::Test, &mut |_, _| ()).expect("rooms are made").source;
    let reader = ClipReader { source, options: config.data.clip_options() };
    let trained = TrainedModel::snapshot(&place.model().valid(), &config.model, true);
    let options = EncodeOptions {
        context: ContextChoice::Spread(config.data.views.max_context),
        hold_out: 0,
        stored_tokens: Some(TokenCount::Count(STORED)),
        grouping: config.clusters.grouping,
        kmeans: config.clusters.kmeans.clone(),
        seed: config.seed,
        model_path: "suite".into(),
    };
    let encoded = encode(&trained, &reader, 0, &options).expect("a room is encoded");
    let path = folder.join("room.clift");
    encoded.scene.write(&path, storage).expect("the folder takes a file");
    Scene::read(&path).expect("what was written is read").0
}

/// Renders a file made on the CPU from three cameras: from all tokens, and from selected ones.
fn draw(place: &Place, storage: TokenFormat) -> Values {
    let folder = tempfile::tempdir().expect("a folder");
    let maker = Place::new(&cpu());
    let maker = if place.is_wrong { maker.wrong() } else { maker };
    let scene = encode_room(&maker, folder.path(), storage);
    let weights_file = folder.path().join("model.safetensors");
    save_weights(&maker.model().valid(), &weights_file).expect("the folder takes a file");
    let renderer = load_renderer(&scene, &weights_file, &place.plain()).expect("the scene's renderer");
    let mut viewer =
        SceneRenderer::new(&scene, renderer, SelectionPreset::Scaled.rules(), &place.plain()).expect("finite rays");
    let between = |share: f64| {
        let [a, b] = [scene.context[0], scene.context[1]];
        let translation = (1.0 - share) * a.c2w.translation + share * b.c2w.translation;
        Camera { c2w: Pose { translation, ..a.c2w }, ..a }
    };
    let path = [0.0, 0.3, 0.8].map(between);
    let mut values = Values::default();
    for (name, count) in [("all tokens", STORED), ("four tokens", 4)] {
        let frames = viewer.render(&path, SIZE[0], SIZE[1], count).expect("finite images");
        let chosen = frames.iter().flat_map(|frame| frame.tokens.iter().flatten()).map(|&id| f64::from(id)).collect();
        let pixels = frames.iter().flat_map(|frame| &frame.pixels).map(|&pixel| f64::from(pixel)).collect();
        values.forward.extend([(format!("{name}, chosen"), chosen), (format!("{name}, pixels"), pixels)]);
    }
    values
}
