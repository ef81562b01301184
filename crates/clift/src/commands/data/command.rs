//! `clift data`: make scenes, tell what there is, check it, index it, convert it.

use clap::Subcommand;

use crate::commands::data::check::CheckArgs;
use crate::commands::data::convert::ConvertArgs;
use crate::commands::data::index::IndexArgs;
use crate::commands::data::info::InfoArgs;
use crate::commands::data::synth::SynthArgs;

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

#[cfg(test)]
mod tests {
    use clap::Parser;
    use clift_data::Split;

    use super::*;
    use crate::cli::{Args, Command};
    use crate::commands::data::convert::ConvertForm;
    use crate::commands::splits::Splits;

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
