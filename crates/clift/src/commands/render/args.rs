//! Arguments of `clift render`.

use std::convert::Infallible;
use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

use clap::builder::RangedU64ValueParser;
use clift_model::{DeviceName, Precision, SelectionPreset, TokenCount};

use crate::commands::parse::parse_size;

/// Arguments of `clift render`.
#[derive(Debug, clap::Args)]
pub struct RenderArgs {
    /// A file that `clift encode` wrote
    #[arg(value_name = "SCENE")]
    pub scene: PathBuf,
    /// Where the camera goes: interpolate, orbit, or a file of poses
    #[arg(long, value_name = "PATH")]
    pub path: CameraPath,
    /// Folder to write to; it must not hold anything yet
    #[arg(long, short, value_name = "DIR")]
    pub out: PathBuf,
    /// Run or weight file to draw with; by default the one it was encoded with
    #[arg(long, value_name = "RUN|MODEL")]
    pub model: Option<PathBuf>,
    /// Tokens of each frame, a number or a share; all by default
    #[arg(long, value_name = "COUNT", conflicts_with = "budget_ms")]
    pub render: Option<TokenCount>,
    /// Draw each frame from as many tokens as this device manages in M milliseconds
    #[arg(long, value_name = "M", value_parser = parse_budget_ms)]
    pub budget_ms: Option<f64>,
    /// How the tokens of a frame are chosen: paper, global or scaled
    #[arg(long, value_name = "PRESET", default_value = "scaled")]
    pub selection: SelectionPreset,
    /// Columns and rows of a frame, multiples of the model's patch; those of the context views by default
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    pub size: Option<[usize; 2]>,
    /// Frames of `interpolate` and `orbit` [default: 60]; a file of poses has its own number
    #[arg(long, value_name = "N", value_parser = RangedU64ValueParser::<usize>::new().range(1..=100_000))]
    pub frames: Option<usize>,
    /// Frames per second of the animation
    #[arg(long, value_name = "F", default_value_t = 20, value_parser = clap::value_parser!(u16).range(1..))]
    pub fps: u16,
    /// Where tensors live: flex, ndarray or wgpu
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceName>,
    /// What the operands of matrix products are: f32, or f16 where the device has it
    #[arg(long, value_name = "f32|f16", default_value_t)]
    pub precision: Precision,
}

/// Where a camera goes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum CameraPath {
    /// Through the context views.
    Interpolate,
    /// Around what they look at.
    Orbit,
    /// As a file says.
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

fn parse_budget_ms(text: &str) -> Result<f64, String> {
    let budget = text.parse().ok().filter(|budget: &f64| *budget > 0.0 && budget.is_finite());
    budget.ok_or_else(|| "write milliseconds per frame, more than 0".into())
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::cli::{Args, Command};

    fn parse(words: &str) -> Result<RenderArgs, clap::Error> {
        match Args::try_parse_from(["clift", "render", "a.clift", "-o", "out"].into_iter().chain(words.split(' ')))?
            .command
        {
            Command::Render(args) => Ok(args),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn a_path_is_a_name_or_a_file() {
        assert_eq!(parse("--path orbit").unwrap().path, CameraPath::Orbit);
        assert_eq!(parse("--path ./orbit").unwrap().path, CameraPath::File("./orbit".into()));
        let args = parse("--path interpolate --size 64x48 --frames 7 --selection global --render 1/4").unwrap();
        assert_eq!((args.path, args.size, args.frames), (CameraPath::Interpolate, Some([64, 48]), Some(7)));
        assert_eq!((args.selection, args.render), (SelectionPreset::Global, Some(TokenCount::Share(0.25))));
    }

    #[test]
    fn counts_and_budgets_are_checked_and_exclude_each_other() {
        for words in [
            "--path orbit --frames 0",
            "--path orbit --fps 0",
            "--path orbit --budget-ms 0",
            "--path orbit --budget-ms nan",
            "--path orbit --budget-ms 30 --render 5",
            "--path orbit --render 0",
            "--path orbit --size 64",
            "--path orbit --selection all",
            "--frames 3",
        ] {
            assert!(parse(words).is_err(), "{words}");
        }
    }
}
