//! Parsers of argument values.

use std::path::PathBuf;
use std::str::FromStr;

use clift_data::Split;
use clift_eval::MethodFilter;
use clift_train::{ExportFormat, RunStep, Stage};

/// Parses two methods, as `kmeans,clift`.
pub(crate) fn parse_methods(text: &str) -> Result<[MethodFilter; 2], String> {
    let parts: Vec<&str> = text.split(',').map(str::trim).filter(|part| !part.is_empty()).collect();
    let [a, b] = parts[..] else { return Err("write two methods, e.g. kmeans,clift".into()) };
    let side = |text| MethodFilter::parse(text).map_err(|error| error.to_string());
    Ok([side(a)?, side(b)?])
}

/// Parses a number of bytes with an optional decimal unit, as `12.5MB`.
pub(crate) fn parse_bytes(text: &str) -> Result<u64, String> {
    let number = text.trim().trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let factor = match text.trim()[number.len()..].to_lowercase().as_str() {
        "" | "b" => 1.0,
        "k" | "kb" => 1e3,
        "m" | "mb" => 1e6,
        "g" | "gb" => 1e9,
        _ => return Err("write a number of bytes, kB, MB or GB".into()),
    };
    match number.trim().parse::<f64>() {
        Ok(number) if number > 0.0 && number * factor < 1e15 => Ok((number * factor).round() as u64),
        _ => Err("write a positive number of bytes, kB, MB or GB".into()),
    }
}

pub(crate) fn parse_format(text: &str) -> Result<ExportFormat, String> {
    match text {
        "pytorch" => Ok(ExportFormat::Pytorch),
        "safetensors" => Ok(ExportFormat::Safetensors),
        "f16" => Ok(ExportFormat::F16),
        _ => Err("write pytorch, safetensors or f16".into()),
    }
}

pub(crate) fn parse_split(text: &str) -> Result<Split, String> {
    let splits = [Split::Train, Split::Test];
    splits.into_iter().find(|split| split.to_string() == text).ok_or_else(|| "write train or test".into())
}

pub(crate) fn parse_training_step(text: &str) -> Result<RunStep, String> {
    let steps = [Stage::Stage1.into(), RunStep::Clusters, Stage::Stage2.into()];
    steps
        .into_iter()
        .find(|step: &RunStep| step.name() == text)
        .ok_or_else(|| "write stage1, clusters or stage2".into())
}

pub(crate) fn parse_count(text: &str) -> Result<usize, String> {
    parse_number(text, |count| *count > 0, "write a number of at least 1")
}

/// Parses the path of a file or folder to read.
pub(crate) fn parse_input(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    if path.exists() { Ok(path) } else { Err("no such file or folder".into()) }
}

/// Parses the directory of a run.
pub(crate) fn parse_run(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    match (path.exists(), path.join("config.toml").is_file()) {
        (true, true) => Ok(path),
        (true, false) => Err("that is no run: it has no config.toml; write the `run_dir` of a `clift train`".into()),
        (false, _) => Err("no such folder; write the `run_dir` of a `clift train`".into()),
    }
}

/// Parses the path of a file to write, before the work whose results it takes.
pub(crate) fn parse_output(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    match folder.filter(|folder| !folder.is_dir()) {
        Some(folder) => Err(format!("no folder {}; create it first", folder.display())),
        None if path.is_dir() => Err("that is a folder; write the name of a file in it".into()),
        None => Ok(path),
    }
}

/// Parses the path of a video, whose extension is `mp4`.
pub(crate) fn parse_video(text: &str) -> Result<PathBuf, String> {
    let path = parse_output(text)?;
    let is_mp4 = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("mp4"));
    if is_mp4 { Ok(path) } else { Err("write a file name that ends with .mp4".into()) }
}

/// Parses `[width, height]` in pixels, as `64x48`.
pub(crate) fn parse_size(text: &str) -> Result<[usize; 2], String> {
    let size = parse_pair(text, "x").or_else(|| parse_pair(text, "X"));
    size.filter(|size| !size.contains(&0)).ok_or_else(|| "write width and height in pixels, e.g. 64x48".into())
}

/// Parses fewest and most frames, as `45..135`.
pub(crate) fn parse_distance(text: &str) -> Result<[usize; 2], String> {
    parse_pair(text, "..").ok_or_else(|| "write fewest and most frames, e.g. 45..135".into())
}

/// Parses context and target frames of a clip, as `4+6`. Poses are normalised by at least two contexts.
pub(crate) fn parse_views(text: &str) -> Result<[usize; 2], String> {
    let views = parse_pair(text, "+").filter(|[context, _]| *context >= 2);
    views.ok_or_else(|| "write contexts (at least 2) and targets, e.g. 4+6".into())
}

pub(crate) fn parse_budget_ms(text: &str) -> Result<f64, String> {
    parse_number(text, |ms: &f64| *ms > 0.0 && ms.is_finite(), "write milliseconds per frame, more than 0")
}

/// Parses a loss of PSNR in dB.
pub(crate) fn parse_loss(text: &str) -> Result<f64, String> {
    parse_number(text, |loss| (1e-3..=10.0).contains(loss), "write a loss in dB, 0.001 to 10")
}

/// Parses how many photos one is left out of: 0 for none, or at least 2.
pub(crate) fn parse_hold_out(text: &str) -> Result<usize, String> {
    parse_number(text, |count| *count != 1, "write 2 or more, such as 8, or 0 for none")
}

/// Parses a size in kB.
pub(crate) fn parse_kb(text: &str) -> Result<f64, String> {
    parse_number(text, |kb| *kb > 0.0 && *kb <= 1e9, "write kilobytes, more than 0")
}

/// Parses a replacement in parameter names, as `attn.qn=attn.q_norm`.
pub(crate) fn parse_rename(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((from, to)) if !from.is_empty() => Ok((from.into(), to.into())),
        _ => Err("write FROM=TO".into()),
    }
}

fn parse_number<T: FromStr>(text: &str, is_valid: impl Fn(&T) -> bool, fix: &str) -> Result<T, String> {
    text.parse().ok().filter(is_valid).ok_or_else(|| fix.into())
}

fn parse_pair(text: &str, separator: &str) -> Option<[usize; 2]> {
    let (first, second) = text.split_once(separator)?;
    Some([first.parse().ok()?, second.parse().ok()?])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_parsed_or_refused() {
        let sizes = ["12", "1.5kB", "3 MB", "2g"].map(|text| parse_bytes(text).unwrap());
        assert_eq!(sizes, [12, 1500, 3_000_000, 2_000_000_000]);
        for text in ["", "MB", "-1", "0", "1TB", "1e99GB", "nan"] {
            assert!(parse_bytes(text).is_err(), "{text}");
        }
        assert_eq!(
            (parse_size("64x48"), parse_distance("6..20"), parse_views("4+6")),
            (Ok([64, 48]), Ok([6, 20]), Ok([4, 6]))
        );
        let refused = [parse_size("64"), parse_size("0x4"), parse_size("4x"), parse_distance("6"), parse_views("1+6")];
        assert!(refused.iter().all(Result::is_err) && parse_count("0").is_err(), "{refused:?}");
        let [file, folder, no_folder] =
            ["x.mp4", ".", "no/such/x.mp4"].map(|path| (parse_output(path), parse_video(path)));
        assert_eq!(file, (Ok("x.mp4".into()), Ok("x.mp4".into())));
        let refused =
            |(file, video): (Result<PathBuf, String>, _), word: &str| file == video && file.unwrap_err().contains(word);
        assert!(refused(folder, "is a folder") && refused(no_folder, "no folder no/such"));
        assert!(parse_input(".").is_ok() && parse_input("no/such").is_err());
        assert!([".", "no/such"].iter().all(|path| parse_run(path).unwrap_err().contains("write the `run_dir`")));
        assert!(parse_budget_ms("0").is_err() && parse_budget_ms("nan").is_err());
    }
}
