//! A scene file, or the test scenes of a run.

use burn::tensor::Device;
use clift_core::{Camera, ClipViews};
use clift_data::ClipReader;
use clift_eval::{Canvas, file_name};
use clift_model::{Renderer, TokenCount, TrainedModel};
use clift_scene::{ContextChoice, Contexts, EncodeOptions, EncodedScene, Scene, TokenCoding, TokenFormat, encode};

use crate::error::ViewError;
use crate::protocol::request::OpenRequest;
use crate::scenes::open_scene::{OpenScene, SceneOrigin, TrueFrame};

/// The scenes that a viewer offers.
pub enum SceneSet {
    /// One scene file.
    File(Box<SceneFile>),
    /// Scenes of a run's data, encoded when they are opened.
    Run(Box<RunScenes>),
}

/// A scene file and its renderer.
pub struct SceneFile {
    /// The scene.
    pub scene: Scene,
    /// Format of the stored tokens.
    pub coding: TokenCoding,
    /// Bytes of the file.
    pub file_bytes: u64,
    /// The renderer, from [`load_renderer`](clift_scene::load_renderer).
    pub renderer: Renderer,
    /// Words after `clift render` that name the file, its model and its device.
    pub render_args: Vec<String>,
}

/// Scenes of a run's data.
pub struct RunScenes {
    /// The trained model.
    pub model: TrainedModel,
    /// The data of the run.
    pub reader: ClipReader,
    /// The offered scenes with their context views, at least one.
    pub items: Vec<(usize, ContextChoice)>,
    /// Settings of the encoding; the context frames and the number of stored tokens are replaced.
    pub options: EncodeOptions,
    /// Offered numbers of stored tokens.
    pub stored_tokens: Vec<TokenCount>,
    /// Words after `clift encode` that name the run and its settings.
    pub encode_args: Vec<String>,
    /// Further words of `clift render` for a scene of the run, such as its device.
    pub render_args: Vec<String>,
}

/// Most true frames of a scene in the page's list, spread evenly.
const MAX_FRAMES: usize = 256;

/// Number format of the scenes of a run.
const RUN_FORMAT: TokenFormat = TokenFormat::F16;

impl SceneSet {
    pub(crate) fn keys(&self) -> Vec<String> {
        match self {
            Self::File(file) => vec![file.scene.key.clone()],
            Self::Run(run) => run.items.iter().map(|(scene, _)| run.reader.source.key(*scene).to_owned()).collect(),
        }
    }

    pub(crate) fn open(&self, request: OpenRequest, device: &Device) -> Result<OpenScene, ViewError> {
        match self {
            Self::File(file) => {
                check_position("scene", request.scene, 1)?;
                let SceneFile { scene, coding, file_bytes, renderer, render_args } = &**file;
                let origin = SceneOrigin {
                    index: 0,
                    coding: *coding,
                    file_bytes: *file_bytes,
                    context_images: None,
                    clusters: None,
                    frames: Vec::new(),
                    storage_counts: vec![scene.num_tokens()],
                    encode_command: None,
                    render_command: command("clift render", render_args),
                };
                OpenScene::new(scene.clone(), renderer.clone(), origin, device)
            }
            Self::Run(run) => run.open(request, device),
        }
    }

    /// Reads a true frame of an open scene, by its position in the list, at the size of the context views.
    pub(crate) fn true_image(&self, open: &OpenScene, frame: usize) -> Result<(Canvas, Camera), ViewError> {
        check_position("frame", frame, open.frames.len())?;
        let Self::Run(run) = self else { return Err(ViewError::NoScene) };
        let views = run.reader.read_views(run.items[open.index].0, &[open.frames[frame].frame], &open.scene.world)?;
        Ok((images(&views)?.remove(0), views.cameras[0]))
    }
}

impl RunScenes {
    fn open(&self, request: OpenRequest, device: &Device) -> Result<OpenScene, ViewError> {
        check_position("scene", request.scene, self.items.len())?;
        let (index, context) = &self.items[request.scene];
        let clift_data::ClipOptions { width, height, .. } = self.reader.options;
        let options = EncodeOptions { context: context.clone(), stored_tokens: None, ..self.options.clone() };
        let num_members = Contexts::choose(&self.reader, *index, &options)?.num_members();
        let num_tokens = self.model.config.num_tokens(num_members, height, width)?;
        let counts = self.storage_counts(num_tokens);
        // Without a request, the count nearest to a quarter.
        let wanted = request.stored.unwrap_or(num_tokens / 4);
        let stored = counts.iter().copied().min_by_key(|count| count.abs_diff(wanted)).unwrap_or(num_tokens);
        let options = EncodeOptions { stored_tokens: Some(TokenCount::Count(stored)), ..options };
        let EncodedScene { mut scene, context: context_views, clusters, .. } =
            encode(&self.model, &self.reader, *index, &options)?;
        scene.tokens = RUN_FORMAT.round(&scene.tokens)?;
        // The key comes from data: as a file name it must not lead to another folder.
        let file = format!("{}.clift", file_name(&scene.key));
        let mut scene_args = vec!["--scene".to_owned(), scene.key.clone()];
        if let ContextChoice::Frames(frames) = context {
            let frames = frames.iter().map(ToString::to_string).collect::<Vec<_>>().join(",");
            scene_args.extend(["--context".to_owned(), frames]);
        }
        let (stored, format) = (stored.to_string(), RUN_FORMAT.name());
        scene_args.extend(["--stored-tokens", &stored, "--format", format, "-o", &file].map(str::to_owned));
        let encode_args: Vec<String> = self.encode_args.iter().cloned().chain(scene_args).collect();
        let render_args: Vec<String> = [file.clone()].into_iter().chain(self.render_args.clone()).collect();
        let origin = SceneOrigin {
            index: request.scene,
            coding: RUN_FORMAT.into(),
            file_bytes: scene.file_bytes(RUN_FORMAT),
            context_images: Some(images(&context_views)?),
            clusters: Some(clusters.assignment().to_vec()),
            frames: self.true_frames(*index, &scene)?,
            storage_counts: counts,
            encode_command: Some(command("clift encode", &encode_args)),
            render_command: command("clift render", &render_args),
        };
        OpenScene::new(scene, self.model.network.renderer.clone(), origin, device)
    }

    /// Lists the frames that are not context views.
    fn true_frames(&self, index: usize, scene: &Scene) -> Result<Vec<TrueFrame>, ViewError> {
        let cameras = self.reader.source.cameras(index)?;
        let others = cameras.iter().enumerate().filter(|(frame, _)| !scene.context_frames.contains(&(*frame as u32)));
        let frames: Vec<TrueFrame> =
            others.map(|(frame, camera)| TrueFrame { frame, c2w: scene.world.normalize(camera.c2w) }).collect();
        Ok(frames.iter().step_by(frames.len().div_ceil(MAX_FRAMES).max(1)).copied().collect())
    }

    /// Returns the offered counts of a scene, ascending; all tokens are always offered.
    fn storage_counts(&self, num_patches: usize) -> Vec<usize> {
        let mut counts: Vec<usize> = self.stored_tokens.iter().filter_map(|count| count.of(num_patches).ok()).collect();
        counts.push(num_patches);
        counts.sort_unstable();
        counts.dedup();
        counts
    }
}

fn check_position(name: &'static str, value: usize, count: usize) -> Result<(), ViewError> {
    if value < count { Ok(()) } else { Err(ViewError::OutOfRange { name, value, last: count.saturating_sub(1) }) }
}

/// Returns a command line for a shell. A word with a NUL, which no shell accepts, is left out.
fn command(start: &str, args: &[String]) -> String {
    let quoted = args.iter().filter_map(|arg| shlex::try_quote(arg).ok());
    [start.into()].into_iter().chain(quoted).collect::<Vec<_>>().join(" ")
}

fn images(views: &ClipViews) -> Result<Vec<Canvas>, ViewError> {
    let images = views.images.chunks_exact(views.height * views.width * 3);
    images.map(|rgb| Ok(Canvas::from_rgb8(rgb, views.height, views.width)?)).collect()
}
