//! `clift data convert`.

use std::time::Instant;

use clift_data::{ConvertOptions, ConvertTo, Encoding, convert};

use super::args::{ConvertArgs, ConvertForm};
use super::open::halves;
use super::text::{bytes, count};
use crate::terminal::{Counter, print_note, print_result};

/// Converts both halves and says what was left out.
pub fn run(args: &ConvertArgs) -> anyhow::Result<()> {
    let to = match args.to {
        ConvertForm::Chunks => ConvertTo::Chunks { target_bytes: args.chunk_mb * 1_000_000 },
        ConvertForm::Scenes => ConvertTo::Scenes,
    };
    let options = ConvertOptions { to, encoding: args.quality.map_or(Encoding::Png, Encoding::Jpeg) };
    for half in halves(&args.dir, args.split)? {
        let (source, ledger) = (&half.opened.source, &half.opened.ledger);
        if ledger.has_gaps() {
            print_note(&format!("{}: {ledger}", half.name()));
        }
        // A folder that is not divided becomes the test half: what `clift eval` and `clift encode` read.
        let folder = args.out.join(half.split.unwrap_or(clift_data::Split::Test).to_string());
        let started = Instant::now();
        let mut counter = Counter::new(&half.name(), source.num_scenes() as u64);
        let converted = convert(source.as_ref(), &folder, options, |done| counter.set(done as u64))?;
        drop(counter);
        for skip in &converted.skipped {
            print_note(&format!("left out {}: {}", skip.key, skip.reason));
        }
        let found = if converted.num_found > 0 {
            format!(", {} of them there already", converted.num_found)
        } else {
            String::new()
        };
        let (scenes, frames) = (count(converted.num_scenes, "scene"), count(converted.num_frames, "frame"));
        let kept = converted.num_frames - converted.num_encoded;
        let seconds = started.elapsed().as_secs_f64();
        let place = folder.display();
        print_result(&format!(
            "{}: {scenes} of {}{found}; {frames} written, {kept} as they were and {} encoded, {} in {seconds:.1} s: {place}",
            half.name(),
            ledger.num_scenes,
            converted.num_encoded,
            bytes(converted.image_bytes),
        ))?;
    }
    Ok(())
}
