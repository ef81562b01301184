//! `clift data poses`.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, bail};
use clift_core::{TEMPORARY, make_folder, plural, publish_folder, remove_leftovers, replace_file};
use clift_data::image_size;
use serde::{Deserialize, Serialize};

use crate::commands::args::shared_args::JsonArg;
use crate::commands::args::splits::{SourceArgs, Splits};
use crate::commands::data::check::{self, CheckArgs};
use crate::commands::data::colmap::Colmap;
use crate::commands::data::tool::Tool;
use crate::exit_code::{Interrupted, usage_bail};
use crate::interrupt::{self, Ending};
use crate::output::stdout::{print_note, print_result, print_warning};

const MIN_PHOTOS: usize = 3;
/// Most photos that are matched each with each by default: 5,000 pairs.
const MAX_EXHAUSTIVE: usize = 100;
/// Longest side of the frames of a film, in pixels.
const FRAME_SIDE: usize = 1920;
const MAX_NAMES: usize = 3;

/// The photos or film from which a capture is made: another one must not continue it.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Origin {
    photos: PathBuf,
    /// Requested frames of a film.
    frames: Option<usize>,
}

struct Capture {
    folder: PathBuf,
    /// COLMAP's database and log, and [`Origin`].
    work: PathBuf,
    images: PathBuf,
    model: PathBuf,
}

pub fn run(args: &PosesArgs) -> anyhow::Result<()> {
    let stop = interrupt::flag(Ending {
        first: "stopping COLMAP; the same command continues\n",
        second: "ended; the same command continues\n",
    })?;
    let capture = Capture::new(&args.out);
    let tool = |name, package| Tool { name, package, log: capture.work.join("log.txt"), stop: &stop };
    tool("colmap", "colmap").output(&["help".as_ref()])?;
    let is_film = args.photos.is_file();
    if is_film {
        tool("ffmpeg", "ffmpeg").output(&["-version".as_ref()])?;
    }
    let photos = if is_film { Vec::new() } else { list_photos(&args.photos)? };
    capture.begin(args, is_film)?;
    if capture.model.exists() {
        print_note("note: the capture is complete; it is only checked");
    } else {
        remove_leftovers(&capture.folder).with_context(|| format!("cleaning {}", capture.folder.display()))?;
        if is_film {
            extract_frames(args, &capture, &tool("ffprobe", "ffmpeg"), &tool("ffmpeg", "ffmpeg"))?;
        } else {
            copy_photos(&args.photos, &photos, &capture.images, &stop)?;
        }
        find_poses(args, &capture, is_film, tool("colmap", "colmap"))?;
    }
    let checked = check::run(&CheckArgs {
        source: SourceArgs { dir: args.out.clone(), set: Vec::new() },
        split: Splits::Both,
        scenes: None,
        json: JsonArg { path: None, force: false },
    });
    let name = args.out.file_name().map_or_else(|| "capture".into(), |name| name.to_string_lossy().into_owned());
    let (folder, scene) = (quoted(&args.out.to_string_lossy()), quoted(&format!("{name}.clift")));
    print_result(&format!("\nnext:\n  clift encode {folder} -o {scene}\n  clift view {scene}"))?;
    checked
}

/// Quotes a word for a shell if it needs that.
fn quoted(word: &str) -> String {
    let is_plain = |c: char| c.is_alphanumeric() || "-_./+,".contains(c);
    if word.chars().all(is_plain) { word.into() } else { format!("'{}'", word.replace('\'', "'\\''")) }
}

impl Capture {
    fn new(folder: &Path) -> Self {
        Self {
            folder: folder.into(),
            work: folder.join("colmap"),
            images: folder.join("images"),
            model: folder.join("sparse").join("0"),
        }
    }

    /// Creates the folder, or continues one that was begun with the same photos.
    fn begin(&self, args: &PosesArgs, is_film: bool) -> anyhow::Result<()> {
        let photos = std::path::absolute(&args.photos).context("resolving the path of the photos")?;
        let origin = Origin { photos, frames: is_film.then_some(args.frames) };
        let path = self.work.join("origin.json");
        let out = self.folder.display();
        if let Ok(bytes) = std::fs::read(&path) {
            let begun: Option<Origin> = serde_json::from_slice(&bytes).ok();
            if begun.as_ref() != Some(&origin) {
                let other = begun.map_or_else(|| "other photos".into(), |begun| begun.photos.display().to_string());
                usage_bail!("{out} was begun with {other}, or another number of frames; choose another folder");
            }
            return Ok(());
        }
        let has_other_images = self.images.exists() && !is_same(&self.images, &args.photos);
        if has_other_images || self.model.exists() || self.folder.join("transforms.json").exists() {
            usage_bail!("{out} has images or cameras already; choose another folder");
        }
        make_folder(&self.work).with_context(|| format!("creating {}", self.work.display()))?;
        let bytes = serde_json::to_vec_pretty(&origin).context("writing JSON")?;
        replace_file(&path, &bytes).with_context(|| format!("writing {}", path.display()))
    }
}

fn is_same(folder: &Path, other: &Path) -> bool {
    folder.canonicalize().is_ok_and(|folder| other.canonicalize().is_ok_and(|other| other == folder))
}

/// Returns the names of the photos in a folder, relative to it, in order. Other files are named in a warning.
fn list_photos(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let (mut photos, mut others, mut folders) = (Vec::new(), Vec::new(), vec![PathBuf::new()]);
    while let Some(below) = folders.pop() {
        let reading = || format!("reading {}", folder.join(&below).display());
        for item in std::fs::read_dir(folder.join(&below)).with_context(reading)? {
            let item = item.with_context(reading)?;
            let name = below.join(item.file_name());
            if item.file_name().to_string_lossy().starts_with('.') {
                continue;
            }
            match item.file_type().with_context(reading)?.is_dir() {
                true if name.components().count() <= 3 => folders.push(name),
                true => {}
                false if image_size(&item.path()).is_ok() => photos.push(name),
                false => others.push(name.display().to_string()),
            }
        }
    }
    photos.sort();
    others.sort();
    if !others.is_empty() {
        let shown = others.iter().take(MAX_NAMES).cloned().collect::<Vec<_>>().join(", ");
        let files = plural(others.len(), "file");
        print_warning(format!("{files} not used, as they are not readable JPEG or PNG images: {shown}"));
    }
    if photos.len() < MIN_PHOTOS {
        let count = plural(photos.len(), "JPEG or PNG image");
        usage_bail!("{count} in {}, expected at least {MIN_PHOTOS}; 20 and more are usual", folder.display());
    }
    Ok(photos)
}

fn copy_photos(from: &Path, photos: &[PathBuf], to: &Path, stop: &AtomicBool) -> anyhow::Result<()> {
    if is_same(from, to) {
        return Ok(());
    }
    for name in photos {
        let (source, target) = (from.join(name), to.join(name));
        let copying = || format!("copying {} to {}", source.display(), target.display());
        if !target.exists() {
            make_folder(target.parent().unwrap_or(to)).with_context(copying)?;
            let bytes = std::fs::read(&source).with_context(copying)?;
            replace_file(&target, &bytes).with_context(copying)?;
        }
        if stop.load(Ordering::SeqCst) {
            return Err(Interrupted.into());
        }
    }
    Ok(())
}

fn extract_frames(args: &PosesArgs, capture: &Capture, ffprobe: &Tool<'_>, ffmpeg: &Tool<'_>) -> anyhow::Result<()> {
    if capture.images.exists() {
        return Ok(());
    }
    let (film, frames) = (args.photos.as_os_str(), args.frames);
    let query = ["-v", "error", "-show_entries", "format=duration", "-of", "csv=p=0"].map(AsRef::as_ref);
    let duration = ffprobe.output(&[&query[..], &[film]].concat())?;
    let seconds: Option<f64> = duration.trim().parse().ok().filter(|seconds| *seconds > 0.0);
    let Some(seconds) = seconds else {
        usage_bail!("ffprobe finds no film in {}; expected a folder of photos or a film", args.photos.display());
    };
    print_note(&format!("ffmpeg extracts {frames} frames of a film of {seconds:.0} s"));
    let unfinished = capture.folder.join(format!("{TEMPORARY}images"));
    make_folder(&unfinished).with_context(|| format!("creating {}", unfinished.display()))?;
    let rate = frames as f64 / seconds;
    let filter = format!(
        "fps={rate},scale=w='min({FRAME_SIDE},iw)':h='min({FRAME_SIDE},ih)':force_original_aspect_ratio=decrease"
    );
    let number = frames.to_string();
    let mut words: Vec<OsString> = ["-nostdin", "-v", "error", "-i"].map(Into::into).into();
    words.push(film.into());
    words.extend(["-vf", &filter, "-frames:v", &number, "-q:v", "2"].map(Into::into));
    words.push(unfinished.join("frame_%05d.jpg").into());
    ffmpeg.run(&words)?;
    publish_folder(&unfinished, &capture.images).with_context(|| format!("writing {}", capture.images.display()))
}

fn find_poses(args: &PosesArgs, capture: &Capture, is_film: bool, tool: Tool<'_>) -> anyhow::Result<()> {
    let photos = list_photos(&capture.images)?;
    let num_images = photos.len();
    let mut sizes = photos.iter().map(|name| image_size(&capture.images.join(name)));
    let first = sizes.next().transpose()?;
    let single_camera = sizes.all(|size| size.ok() == first);
    if !single_camera {
        print_note("note: the photos have several sizes, so that each gets a camera of its own");
    }
    let sequential = match args.matching {
        Some(matching) => matching == Matching::Neighbours,
        None => is_film || num_images > MAX_EXHAUSTIVE,
    };
    let pairs = if sequential { "neighbours in the order of the names" } else { "each with each" };
    print_note(&format!("COLMAP: {}, matched {pairs}; log: {}", plural(num_images, "photo"), tool.log.display()));
    let (images, folder, use_gpu) = (&capture.images, &capture.work, args.gpu);
    let colmap = Colmap { tool, images, folder, single_camera, sequential, use_gpu };
    colmap.extract_features()?;
    colmap.match_features()?;
    let models = capture.work.join(format!("{TEMPORARY}models"));
    make_folder(&models).with_context(|| format!("creating {}", models.display()))?;
    let found = colmap.map(&models)?;
    let Some((largest, num_posed)) = found.first() else {
        bail!(
            "COLMAP found no cameras: each place must be in three photos or more, taken from different points; log: {}",
            colmap.tool.log.display()
        );
    };
    let of_several =
        if found.len() > 1 { format!(", in the largest of {} models", found.len()) } else { String::new() };
    print_result(&format!("{num_posed} of {} have a pose{of_several}", plural(num_images, "photo")))?;
    let writing = || format!("writing {}", capture.model.display());
    make_folder(&capture.folder.join("sparse")).with_context(writing)?;
    publish_folder(largest, &capture.model).with_context(writing)?;
    remove_leftovers(&capture.work).with_context(writing)
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Matching {
    /// Each photo with each: up to about 100 photos in any order
    All,
    /// Each photo with its neighbours in the order of the names
    Neighbours,
}

#[derive(Debug, clap::Args)]
pub struct PosesArgs {
    /// Folder of JPEG or PNG photos, or a film
    #[arg(value_name = "PHOTOS_OR_FILM")]
    pub photos: PathBuf,
    /// Capture to write; continues an interrupted one
    #[arg(short, long, value_name = "CAPTURE")]
    pub out: PathBuf,
    /// Number of frames to extract from a film
    #[arg(long, value_name = "N", default_value_t = 100, value_parser = clap::builder::RangedU64ValueParser::<usize>::new().range(3..=2000))]
    pub frames: usize,
    /// Pairs to match [default: all; neighbours for a film and above 100 photos]
    #[arg(long, value_enum)]
    pub matching: Option<Matching>,
    /// Let COLMAP use a GPU; it needs CUDA or a screen
    #[arg(long)]
    pub gpu: bool,
}
