//! Encodes a folder of posed photos as a scene file, renders a view of it, and compares a rendering with a photo.
//!
//! ```text
//! cargo run --release -p clift-eval --example encode_and_render -- RUN PHOTOS OUT
//! ```
//!
//! `RUN` is a run directory with trained weights, such as `models/rooms`. `PHOTOS` has images with cameras in any supported
//! layout, such as COLMAP or nerfstudio. Writes `OUT.clift` and `OUT.png`.

use std::error::Error;
use std::path::Path;

use clift_data::{ClipReader, DataConfig, DatasetRoot, SourceOptions, Split, open_source};
use clift_eval::Canvas;
use clift_model::{DeviceName, ModelPath, SelectionPreset, TrainedModel};
use clift_scene::{ContextChoice, EncodeOptions, SceneOptions, SceneRenderer, TokenCoding, encode_scene};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [run, photos, out] = &arguments[..] else { return Err("usage: encode_and_render RUN PHOTOS OUT".into()) };

    // Open the model, and the photos in the size and with the normalization of poses that the model was trained on.
    let path = ModelPath::find(Path::new(run))?;
    let model = TrainedModel::open(Path::new(run), &DeviceName::Flex.open()?)?;
    let source =
        open_source(&DatasetRoot::find(Path::new(photos))?, Split::Test, &SourceOptions::default(), &mut |_, _| ())?
            .source;
    let config: toml::Table = std::fs::read_to_string(path.dir.join("config.toml"))?.parse()?;
    let data: DataConfig = config["data"].clone().try_into()?;
    let reader = ClipReader { source, options: data.clip_options() };

    // Encode the first scene: four context views, a quarter of the tokens, stored as f16.
    let options = SceneOptions {
        encode: EncodeOptions {
            context: ContextChoice::Spread(4),
            model_path: run.clone(),
            ..EncodeOptions::default()
        },
        refine_steps: 0,
        coding: Some(TokenCoding::F16),
        weights: path.weights,
        out: format!("{out}.clift").into(),
    };
    let written = encode_scene(&model, &reader, 0, &options, &mut |_, _| ())?;
    let scene = &written.encoded.scene;

    // Render the second context view from half of the stored tokens: those nearest to its camera.
    let (renderer, rules) = (model.network.renderer.clone(), SelectionPreset::default().rules());
    let mut renderer = SceneRenderer::new(scene, renderer, rules, &model.device)?;
    let view = renderer.render(&scene.context[1..2], scene.height, scene.width, scene.num_tokens() / 2)?.remove(0);
    Canvas::from_unit(&view.pixels, scene.width, scene.height)?.write_png(Path::new(&format!("{out}.png")))?;

    // A rendering of a photo that is not a context view, compared with the photo.
    for check in written.others {
        println!("frame {}: {:.2} dB, the nearest context view {:.2} dB", check.frame, check.psnr, check.baseline_psnr);
    }
    Ok(())
}
