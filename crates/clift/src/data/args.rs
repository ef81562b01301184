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
    /// A folder of scenes, one scene, or a config (TOML)
    #[arg(value_name = "DIR|CONFIG")]
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
}
