//! Arguments of `clift data`.

use std::path::PathBuf;

use clap::{Subcommand, ValueEnum};
use clift_data::Split;

/// What to do with data.
#[derive(Debug, Subcommand)]
pub enum DataCommand {
    /// Write synthetic scenes as RealEstate10K-style chunks
    ///
    /// Ray-traced rooms with exact cameras go to OUT/train and OUT/test as NNNNNN.torch files, which `torch.load`
    /// reads too, each folder with its index.json. With the test split comes `OUT/evaluation_index.json`, for
    /// `clift eval --index`. Prints the lines of a config that trains on them.
    #[command(after_help = "\
Examples:
  clift data synth /data/rooms
  clift data synth /data/rooms --scenes 2000 --frames 24 --size 64x64 --seed 7
  clift data synth /data/rooms --split test --scenes 50 --quality 95
  clift data synth /data/rooms --set specular=0.8 --set 'num_objects=[4, 8]'

Keys of --set, as in [data.synthetic] of a config: fov_deg, room_half_size,
num_objects, path_length, texture_frequency, specular, samples_per_pixel.")]
    Synth(SynthArgs),
    /// Tell what a data folder holds, or what a config uses of it
    ///
    /// Any layout is recognised: chunks, files per scene, RealEstate10K's text, DL3DV's folders, captures with
    /// transforms.json or a COLMAP model. Per split: scenes, frames (smallest / median / largest), picture size, field
    /// of view, extent of the camera path, frames without a picture. For a config also what its filters, its views and its evaluation leave, and the tokens of a scene.
    #[command(after_help = "\
Examples:
  clift data info /data/re10k
  clift data info captures/attic
  clift data info configs/tiny.toml
  clift data info configs/re10k.toml --set data.filters.min_frames=60 --json info.json")]
    Info(InfoArgs),
    /// Check whether scenes can be believed: pictures, cameras, and poses against the pictures
    ///
    /// Reads every frame of every scene, in any layout; looks at sizes, intrinsics, fields of view, rotations, baselines
    /// and pictures that repeat; and matches corners between frames, which must lie on the epipolar lines that the
    /// cameras predict. Prints a table with the reasons. Exits with 1 if a scene is flagged, or if there is none.
    #[command(after_help = "\
Examples:
  clift data check /data/re10k --scenes 20
  clift data check captures/fox --pictures fox-lines --json fox.json")]
    Check(CheckArgs),
    /// Make an evaluation index of one's own data: pairs of frames that overlap, and targets between them
    ///
    /// The way pixelSplat's index was made: a random frame, and a random partner among those whose view overlaps with
    /// its own, in both directions, by --overlap or more. What overlaps is decided by poses alone: the share of the
    /// rays of one view that cross the other at any depth. Scenes without such a pair become null.
    #[command(after_help = "\
Examples:
  clift data index /data/re10k -o index.json
  clift data index captures -o index.json --distance 6..20 --context 4 --targets 6")]
    Index(IndexArgs),
    /// Write any layout as pixelSplat's chunks or as a file per scene
    ///
    /// OUT/train and OUT/test receive what DIR's halves hold; a folder without halves becomes OUT/test, unless
    /// `data.files.test_scenes` divides it. Pictures keep their files, byte by byte, unless their lens distortion has to
    /// be undone. Interrupted, it goes on where it was: SHA256SUMS tells which files are complete, and
    /// `sha256sum -c SHA256SUMS` verifies them at any time. Exits with 1 if a half has no scene that can be converted.
    #[command(after_help = "\
Examples:
  clift data convert captures/fox fox-chunks --to chunks
  clift data convert /data/re10k-txt /data/re10k --to chunks --split test
  clift data convert /data/re10k /data/re10k-scenes --to scenes
  clift data convert /data/dl3dv /data/dl3dv-chunks --to chunks --set data.files.test_scenes=benchmark.txt")]
    Convert(ConvertArgs),
}

/// Arguments of `clift data check`.
#[derive(Debug, clap::Args)]
pub struct CheckArgs {
    /// Scenes in any layout, or one scene
    pub dir: PathBuf,
    /// Which half, where there are two
    #[arg(long, value_enum, default_value_t = Splits::Both)]
    pub split: Splits,
    /// Check the first N scenes of each half
    #[arg(long, value_name = "N")]
    pub scenes: Option<usize>,
    /// Write what was found as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Write a picture of every scene there: two frames with epipolar lines
    #[arg(long, value_name = "OUT")]
    pub pictures: Option<PathBuf>,
    /// Say where parts of the layout are, as in a config: `--set data.files.image_folder=images_4`
    #[arg(long, value_name = "data.files.KEY=TOML")]
    pub set: Vec<String>,
}

/// Arguments of `clift data index`.
#[derive(Debug, clap::Args)]
pub struct IndexArgs {
    /// Scenes in any layout
    pub dir: PathBuf,
    /// Where to write
    #[arg(long, short, value_name = "FILE")]
    pub out: PathBuf,
    /// Which half, where there are two
    #[arg(long, value_enum, default_value_t = Splits::Test)]
    pub split: Splits,
    /// Context frames per scene
    #[arg(long, value_name = "N", default_value_t = 4)]
    pub context: usize,
    /// Target frames per scene
    #[arg(long, value_name = "N", default_value_t = 3)]
    pub targets: usize,
    /// Fewest and most frames from the first context to the last
    #[arg(long, value_name = "A..B", default_value = "45..135", value_parser = parse_distance)]
    pub distance: [usize; 2],
    /// Least overlap of the first and the last context
    #[arg(long, value_name = "SHARE", default_value_t = 0.6)]
    pub overlap: f64,
    /// Decides which of the possible frames are taken
    #[arg(long, value_name = "S", default_value_t = 123)]
    pub seed: u64,
    /// Say where parts of the layout are, as in a config: `--set data.files.image_folder=images_4`
    #[arg(long, value_name = "data.files.KEY=TOML")]
    pub set: Vec<String>,
}

/// Arguments of `clift data convert`.
#[derive(Debug, clap::Args)]
pub struct ConvertArgs {
    /// Scenes in any layout, or one scene
    pub dir: PathBuf,
    /// Folder to write to: new, or one that an interrupted conversion left
    pub out: PathBuf,
    /// What to write
    #[arg(long, value_enum)]
    pub to: ConvertForm,
    /// Which half, where there are two
    #[arg(long, value_enum, default_value_t = Splits::Both)]
    pub split: Splits,
    /// Size at which a chunk is closed, in megabytes of pictures
    #[arg(long, value_name = "M", default_value_t = 100, value_parser = clap::value_parser!(u64).range(1..=4000))]
    pub chunk_mb: u64,
    /// Store pictures that need encoding as JPEG of this quality, 1 to 100, instead of PNG (without loss)
    #[arg(long, value_name = "Q", value_parser = clap::value_parser!(u8).range(1..=100))]
    pub quality: Option<u8>,
    /// Say where parts of the layout are, as in a config: `--set data.files.image_folder=images_4`
    #[arg(long, value_name = "data.files.KEY=TOML")]
    pub set: Vec<String>,
}

/// What is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ConvertForm {
    /// NNNNNN.torch files of many scenes, with index.json
    Chunks,
    /// A KEY.torch file per scene
    Scenes,
}

/// Arguments of `clift data synth`.
#[derive(Debug, clap::Args)]
pub struct SynthArgs {
    /// Folder to write to; it may hold the other split, of the same size, and nothing else
    pub out: PathBuf,
    /// Scenes of each split [default: 100]
    #[arg(long, value_name = "N")]
    pub scenes: Option<usize>,
    /// Frames of each scene [default: 16]
    #[arg(long, value_name = "F")]
    pub frames: Option<usize>,
    /// Columns and rows of a frame [default: 32x32]
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    pub size: Option<[usize; 2]>,
    /// Seed of all scenes; no two seeds share one [default: 0]
    #[arg(long, value_name = "S")]
    pub seed: Option<u64>,
    /// Which scenes to write
    #[arg(long, value_enum, default_value_t = Splits::Both)]
    pub split: Splits,
    /// Change another key of the scenes; wins over the options above
    #[arg(long, value_name = "KEY=TOML")]
    pub set: Vec<String>,
    /// Size at which a chunk is closed, in megabytes of pictures
    #[arg(long, value_name = "M", default_value_t = 100, value_parser = clap::value_parser!(u64).range(1..=4000))]
    pub chunk_mb: u64,
    /// Store frames as JPEG of this quality, 1 to 100, instead of PNG (without loss)
    #[arg(long, value_name = "Q", value_parser = clap::value_parser!(u8).range(1..=100))]
    pub quality: Option<u8>,
}

/// Arguments of `clift data info`.
#[derive(Debug, clap::Args)]
pub struct InfoArgs {
    /// A folder of scenes, one scene, a config (TOML) or an evaluation index (JSON)
    #[arg(value_name = "DIR|CONFIG|INDEX")]
    pub path: PathBuf,
    /// Change a key of the config: `--set data.filters.min_frames=60`
    #[arg(long, value_name = "KEY=TOML")]
    pub set: Vec<String>,
    /// Also write it to a JSON file
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// One split, or both.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Splits {
    /// Scenes to train on
    Train,
    /// Scenes held back
    Test,
    /// Both
    Both,
}

impl Splits {
    /// The splits meant.
    pub fn list(self) -> &'static [Split] {
        match self {
            Self::Train => &[Split::Train],
            Self::Test => &[Split::Test],
            Self::Both => &[Split::Train, Split::Test],
        }
    }
}

pub fn parse_size(text: &str) -> Result<[usize; 2], String> {
    let size =
        text.split_once(['x', 'X']).and_then(|(width, height)| Some([width.parse().ok()?, height.parse().ok()?]));
    size.filter(|size| !size.contains(&0)).ok_or_else(|| "write columns and rows, as 64x48".into())
}

fn parse_distance(text: &str) -> Result<[usize; 2], String> {
    let distance = text.split_once("..").and_then(|(near, far)| Some([near.parse().ok()?, far.parse().ok()?]));
    distance.ok_or_else(|| "write fewest and most frames, as 45..135".into())
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::args::{Args, Command};

    fn parse(words: &str) -> Result<DataCommand, clap::Error> {
        match Args::try_parse_from(["clift", "data"].into_iter().chain(words.split(' ')))?.command {
            Command::Data { command } => Ok(command),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn synth_takes_scenes_frames_size_seed_and_split() {
        let words = "synth out --scenes 5 --frames 8 --size 64x48 --seed 3 --split test --quality 90 --chunk-mb 7";
        let Ok(DataCommand::Synth(args)) = parse(words) else { panic!("no synth") };
        assert_eq!((args.scenes, args.frames, args.size, args.seed), (Some(5), Some(8), Some([64, 48]), Some(3)));
        assert_eq!((args.split.list(), args.quality, args.chunk_mb), (&[Split::Test][..], Some(90), 7));
        let Ok(DataCommand::Synth(args)) = parse("synth out") else { panic!("no synth") };
        assert_eq!((args.split.list().len(), args.quality, args.chunk_mb), (2, None, 100));
    }

    #[test]
    fn values_out_of_range_are_refused_when_they_are_typed() {
        for words in
            ["--size 64", "--size 0x4", "--size 4x", "--quality 0", "--quality 101", "--split all", "--chunk-mb 0"]
        {
            assert!(parse(&format!("synth out {words}")).is_err(), "{words}");
        }
        assert!(parse("synth").is_err() && parse("info").is_err());
    }

    #[test]
    fn info_takes_a_folder_or_a_config_and_where_to_write_json() {
        let Ok(DataCommand::Info(args)) = parse("info a.toml --set data.width=64 --json info.json") else {
            panic!("no info")
        };
        assert_eq!((args.path, args.set.len(), args.json), ("a.toml".into(), 1, Some("info.json".into())));
    }

    #[test]
    fn check_index_and_convert_take_any_folder() {
        let Ok(DataCommand::Check(args)) = parse("check dir --json f.json --pictures out --scenes 3") else {
            panic!("no check")
        };
        assert_eq!((args.split, args.scenes, args.pictures), (Splits::Both, Some(3), Some("out".into())));
        let Ok(DataCommand::Index(args)) = parse("index dir -o i.json --distance 6..20 --targets 5") else {
            panic!("no index")
        };
        assert_eq!((args.distance, args.context, args.targets, args.split), ([6, 20], 4, 5, Splits::Test));
        let words = "convert dir out --to scenes --set data.files.undistort=false";
        let Ok(DataCommand::Convert(args)) = parse(words) else { panic!("no convert") };
        assert_eq!((args.to, args.chunk_mb, args.quality, args.set.len()), (ConvertForm::Scenes, 100, None, 1));
        for words in
            ["index dir", "index dir -o f --distance 6", "convert dir out", "convert dir out --to zip", "check"]
        {
            assert!(parse(words).is_err(), "{words}");
        }
    }
}
