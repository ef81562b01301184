//! Shared argument parsers.

use clift_eval::MethodFilter;
use clift_train::Stage;

pub(crate) fn parse_sides(text: &str) -> Result<[MethodFilter; 2], String> {
    let parts: Vec<&str> = text.split(',').map(str::trim).filter(|part| !part.is_empty()).collect();
    let [a, b] = parts[..] else { return Err("write two variants, such as kmeans,clift".into()) };
    Ok([MethodFilter::parse(a), MethodFilter::parse(b)])
}

/// Bytes, or so many kB, MB, GB of a thousand each.
pub(crate) fn parse_bytes(text: &str) -> Result<u64, String> {
    let text = text.trim();
    let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic()).trim();
    let factor = match text[text.trim_end_matches(|c: char| c.is_ascii_alphabetic()).len()..].to_lowercase().as_str() {
        "" | "b" => 1.0,
        "k" | "kb" => 1e3,
        "m" | "mb" => 1e6,
        "g" | "gb" => 1e9,
        _ => return Err("write a number of bytes, or of kB, MB or GB".into()),
    };
    match digits.parse::<f64>() {
        Ok(number) if number > 0.0 && number * factor < 1e15 => Ok((number * factor).round() as u64),
        _ => Err("write a positive number of bytes, or of kB, MB or GB".into()),
    }
}

pub(crate) fn parse_stage(text: &str) -> Result<Stage, String> {
    let stages = [Stage::Stage1, Stage::Clusters, Stage::Stage2];
    stages.into_iter().find(|stage| stage.name() == text).ok_or_else(|| "write stage1, clusters or stage2".into())
}

pub(crate) fn parse_overfit(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(count) if count > 0 => Ok(count),
        _ => Err("write how many scenes, at least 1".into()),
    }
}

pub(crate) fn parse_repeats(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(count) if count > 0 => Ok(count),
        _ => Err("write how often, at least 1".into()),
    }
}

pub fn parse_size(text: &str) -> Result<[usize; 2], String> {
    let size =
        text.split_once(['x', 'X']).and_then(|(width, height)| Some([width.parse().ok()?, height.parse().ok()?]));
    size.filter(|size| !size.contains(&0)).ok_or_else(|| "write columns and rows, as 64x48".into())
}

pub(crate) fn parse_distance(text: &str) -> Result<[usize; 2], String> {
    let distance = text.split_once("..").and_then(|(near, far)| Some([near.parse().ok()?, far.parse().ok()?]));
    distance.ok_or_else(|| "write fewest and most frames, as 45..135".into())
}
