//! Arguments of `clift render`.

use std::convert::Infallible;
use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

use clap::builder::RangedU64ValueParser;
use clift_model::{DeviceName, PatchGrids, Precision, SelectionPreset, TokenCount};

use crate::commands::args::parse::{parse_budget_ms, parse_size, parse_video};

#[derive(Debug, clap::Args)]
pub struct RenderArgs {
    /// Scene file from `clift encode`
    #[arg(value_name = "SCENE")]
    pub scene: PathBuf,
    /// Camera path: interpolate, orbit, a transforms.json or a file of poses
    #[arg(long, value_name = "PATH")]
    pub path: CameraPath,
    /// Output folder
    #[arg(long, short, value_name = "DIR")]
    pub out: PathBuf,
    /// Replace the frames in the output folder
    #[arg(long)]
    pub force: bool,
    /// Run or weight file [default: the one the scene was encoded with]
    #[arg(long, value_name = "RUN|MODEL")]
    pub model: Option<PathBuf>,
    /// Tokens rendered per frame, as a number or a share [default: all]
    #[arg(long, value_name = "COUNT", conflicts_with = "budget_ms")]
    pub render: Option<TokenCount>,
    /// Render as many tokens per frame as this device can in M milliseconds
    #[arg(long, value_name = "M", value_parser = parse_budget_ms)]
    pub budget_ms: Option<f64>,
    /// Select rendered tokens by this rule: paper, global or scaled
    #[arg(long, value_name = "PRESET", default_value = "scaled")]
    pub selection: SelectionPreset,
    /// Average 1, 2 or 4 renderings with shifted patches [default: the model's]
    #[arg(long, value_name = "COUNT")]
    pub patch_grids: Option<PatchGrids>,
    /// Width and height of a frame in pixels [default: context]
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    pub size: Option<[usize; 2]>,
    /// Number of frames of `interpolate` and `orbit` [default: 60]
    #[arg(long, value_name = "N", value_parser = RangedU64ValueParser::<usize>::new().range(1..=100_000))]
    pub frames: Option<usize>,
    /// Frames per second of the animation
    #[arg(long, value_name = "F", default_value_t = 20, value_parser = clap::value_parser!(u16).range(1..))]
    pub fps: u16,
    /// Also write an MP4 (H.264) of the path, through `ffmpeg` on the PATH
    ///
    /// Without `ffmpeg` a warning says so, and the animated PNG is the only animation.
    #[arg(long, value_name = "FILE.mp4", value_parser = parse_video)]
    pub video: Option<PathBuf>,
    /// Device: flex, ndarray or wgpu [default: flex]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceName>,
    /// Operands of matrix products: f32, bf16 or f16 [default: bf16 if the CPU has its instructions, else f32]
    #[arg(long, value_name = "PRECISION")]
    pub precision: Option<Precision>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub enum CameraPath {
    /// Through the context views.
    Interpolate,
    /// Around a small ellipse about the mean context view, facing the point that the context views look at.
    Orbit,
    File(PathBuf),
}

impl fmt::Display for CameraPath {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Interpolate => f.write_str("interpolate"),
            Self::Orbit => f.write_str("orbit"),
            Self::File(path) => path.display().fmt(f),
        }
    }
}

impl FromStr for CameraPath {
    type Err = Infallible;

    fn from_str(text: &str) -> Result<Self, Infallible> {
        Ok(match text {
            "interpolate" => Self::Interpolate,
            "orbit" => Self::Orbit,
            file => Self::File(file.into()),
        })
    }
}
