//! The `clift data` subcommands.

use clap::Subcommand;

use crate::commands::data::check::CheckArgs;
use crate::commands::data::index::IndexArgs;
use crate::commands::data::info::InfoArgs;
use crate::commands::data::poses::PosesArgs;
use crate::commands::data::synth::SynthArgs;

/// Commands for data sets.
#[derive(Debug, Subcommand)]
pub enum DataCommand {
    /// Create synthetic scenes as RealEstate10K-style chunks
    ///
    /// Ray-traced scenes with exact cameras are written to OUT/train and OUT/test as NNNNNN.torch files, which
    /// `torch.load` reads too, with an index.json per folder. The test split also gets `OUT/evaluation_index.json`, for
    /// `clift eval --index`.
    #[command(after_help = "\
Examples:
  clift data synth /data/rooms
  clift data synth /data/rooms --scenes 2000 --frames 24 --size 64x64 --seed 7
  clift data synth /data/rooms --split test --scenes 50
  clift data synth /data/rooms --set specular=0.8 --set path_length=2
  clift data synth /data/real --look real --frames 32 --size 64x64

Keys of --set for rooms, as in [data.synthetic] of a config: fov_deg,
path_length, texture_frequency, plain_share, specular, samples_per_pixel.")]
    Synth(SynthArgs),
    /// Find the camera poses of photos or a film with COLMAP
    ///
    /// Runs an installed COLMAP (and ffmpeg for a film) with settings for 20 to 200 photos, keeps the largest model, and
    /// checks it as `clift data check`. Writes CAPTURE/images, CAPTURE/sparse/0 and CAPTURE/colmap, which has COLMAP's log
    /// and database. Ten photos take about two minutes on two cores, a hundred up to an hour. The same command continues
    /// an interrupted one.
    #[command(after_help = "\
Examples:
  clift data poses photos/attic -o captures/attic
  clift data poses attic.mp4 -o captures/attic --frames 150
  clift data poses photos/walk -o captures/walk --matching neighbours")]
    Poses(PosesArgs),
    /// Describe a data set
    ///
    /// Recognises every layout: chunks, files per scene, RealEstate10K text files, DL3DV folders, captures with
    /// transforms.json or a COLMAP model. Prints per split: scenes, frames (smallest / median / largest), image size,
    /// field of view, extent of the camera path, frames without an image.
    #[command(after_help = "\
Examples:
  clift data info /data/re10k
  clift data info captures/attic --json info.json")]
    Info(InfoArgs),
    /// Check images, cameras, and whether poses match the images
    ///
    /// Reads every frame of every scene, in any layout. Checks image sizes, intrinsics, fields of view, rotations,
    /// baselines and repeated images. Matches corners between frames and measures their distance to the epipolar lines of
    /// the cameras. Prints a table with the reasons. Exits with 1 if a scene is flagged or if there are no scenes.
    #[command(after_help = "\
Examples:
  clift data check /data/re10k --scenes 20
  clift data check captures/fox --json fox.json")]
    Check(CheckArgs),
    /// Create an evaluation index from pairs of overlapping frames
    ///
    /// Follows pixelSplat: samples a frame, and a partner among the frames whose views overlap with it in both
    /// directions by --overlap or more; targets lie between them. The overlap depends on poses only: the share of rays of
    /// one view that cross the other view at any depth. Scenes without such a pair become null.
    #[command(after_help = "\
Examples:
  clift data index /data/re10k -o index.json
  clift data index captures -o index.json --distance 6..20 --context 4 --targets 6")]
    Index(IndexArgs),
}
