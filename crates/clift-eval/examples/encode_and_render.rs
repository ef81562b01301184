//! Encodes a folder of posed photos as a scene file, and renders the view of one frame from the stored tokens.
//!
//! ```text
//! cargo run --release -p clift-eval --example encode_and_render -- RUN PHOTOS OUT
//! ```
//!
//! `RUN` is a run directory with trained weights. `PHOTOS` has images with cameras in any supported layout, such as COLMAP
//! or nerfstudio. Writes `OUT.clift` and `OUT.png`.

use std::error::Error;
use std::path::Path;

use burn::tensor::{Tensor, TensorData};
use clift_core::{PoseRotation, PoseScale};
use clift_data::{ClipOptions, ClipReader, DatasetRoot, SourceOptions, Split, ViewIndices, open_source};
use clift_eval::{Canvas, EncodeOptions, encode};
use clift_model::{Cameras, DeviceName, Grouping, KMeans, ModelPath, TokenCount, TokenFormat, TrainedModel};

/// Images are scaled and cropped to the size that the model was trained on.
const SIZE_PX: usize = 256;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [run, photos, out] = &arguments[..] else { return Err("usage: encode_and_render RUN PHOTOS OUT".into()) };

    // Open the model and the photos.
    let path = ModelPath::find(Path::new(run))?;
    let model = TrainedModel::open(&path, &path.config()?, &DeviceName::Flex.open()?)?;
    let source = open_source(&DatasetRoot::find(Path::new(photos))?, Split::Test, &SourceOptions::default())?.source;
    let (pose_rotation, pose_scale) = (PoseRotation::default(), PoseScale::default());
    let options =
        ClipOptions { width: SIZE_PX, height: SIZE_PX, pose_rotation, pose_scale, exact_principal_point: false };
    let reader = ClipReader { source, options };

    // Encode the first scene: four context views, a quarter of the tokens, stored as f16.
    let options = EncodeOptions {
        context: None,
        num_context: 4,
        storage: TokenCount::Share(0.25),
        grouping: Grouping::Kmeans,
        kmeans: KMeans::default(),
        seed: 0,
        model_path: run.clone(),
    };
    let scene = encode(&model, &reader, 0, &options)?.scene;
    scene.write(Path::new(&format!("{out}.clift")), TokenFormat::F16)?;

    // Render the middle frame.
    let context = scene.context_frames.iter().map(|&frame| frame as usize).collect();
    let target = vec![reader.source.num_frames(0)? / 2];
    let clip = reader.read(0, &ViewIndices { context, target })?;
    let shape = [1, scene.num_tokens(), scene.tokens.len() / scene.num_tokens()];
    let tokens = Tensor::from_data(TensorData::new(scene.tokens, shape), &model.device);
    let image = model.network.render(tokens, &Cameras::upload(&[&clip.target], &model.device)?); // [1, 1, H, W, 3]
    let pixels: Vec<f32> = image.into_data().convert::<f32>().try_to_vec().map_err(|error| format!("{error:?}"))?;
    Canvas::from_unit(&pixels, SIZE_PX, SIZE_PX)?.write_png(Path::new(&format!("{out}.png")))?;
    Ok(())
}
