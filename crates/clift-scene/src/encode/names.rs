//! Scenes and frames by their names.

use clift_data::SceneSource;

use crate::error::SceneError;

const MAX_LISTED_NAMES: usize = 8;

/// Returns the index of the scene with this key, or of the only scene.
pub fn find_scene(source: &dyn SceneSource, key: Option<&str>) -> Result<usize, SceneError> {
    let num_scenes = source.num_scenes();
    let mut keys: Vec<&str> = (0..num_scenes.min(MAX_LISTED_NAMES)).map(|scene| source.key(scene)).collect();
    if num_scenes > MAX_LISTED_NAMES {
        keys.push("..");
    }
    let keys = keys.join(", ");
    match (key, key.and_then(|key| source.find(key))) {
        (_, Some(scene)) => Ok(scene),
        (Some(key), None) => Err(SceneError::request(format!("no scene {key}; the {num_scenes} scenes are: {keys}"))),
        (None, None) if num_scenes == 1 => Ok(0),
        (None, None) => Err(SceneError::request(format!("{num_scenes} scenes; choose one with --scene: {keys}"))),
    }
}

/// Returns the positions of frames that are given by position or file name, with or without extension. Numbers alone are
/// positions, unless one has leading zeros, as names of images have. `names` are those of all frames, in order.
pub fn frame_positions(frames: &[String], names: &[String]) -> Result<Vec<usize>, SceneError> {
    let is_padded = |frame: &str| frame.len() > 1 && frame.starts_with('0');
    let numbers = frames.iter().map(|frame| frame.trim().parse()).collect();
    if let (Ok(positions), false) = (numbers, frames.iter().any(|frame| is_padded(frame.trim()))) {
        return Ok(positions);
    }
    let position = |frame: &String| {
        let frame = frame.trim();
        let stem = |name: &String| name.rsplit_once('.').is_some_and(|(stem, _)| stem == frame);
        let named = names.iter().position(|name| name == frame).or_else(|| names.iter().position(stem));
        let number = || if is_padded(frame) { None } else { frame.parse().ok() };
        named.or_else(number).ok_or_else(|| {
            let first = names.iter().take(MAX_LISTED_NAMES).map(String::as_str).collect::<Vec<_>>().join(", ");
            SceneError::request(match names.len() {
                0 => format!("--context {frame}: the frames of this data set have no file names; write positions"),
                count => format!("--context: no frame {frame}; the {count} frames start with {first}"),
            })
        })
    };
    frames.iter().map(position).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn context_frames_are_positions_or_file_names() {
        let of = |frames: &[&str], names: &[&str]| {
            let [frames, names] = [frames, names].map(|list| list.iter().map(ToString::to_string).collect::<Vec<_>>());
            frame_positions(&frames, &names).map_err(|error| error.to_string())
        };
        let positions = |frames: &[&str]| of(frames, &["a.jpg", "b.v2.png", "7.png", "0", "003.jpg"]);
        assert_eq!(positions(&["7", "0"]).unwrap(), [7, 0], "numbers alone are positions");
        assert_eq!(positions(&["003", " 1"]).unwrap(), [4, 1], "with leading zeros, names");
        assert_eq!(positions(&["b.v2.png", "a", "7.png", "2"]).unwrap(), [1, 0, 2, 2]);
        assert_eq!(
            positions(&["003", "001"]).unwrap_err(),
            "--context: no frame 001; the 5 frames start with a.jpg, b.v2.png, 7.png, 0, 003.jpg"
        );
        assert_eq!(of(&["front/0.png", "back/0"], &["back/0.png", "front/0.png"]).unwrap(), [1, 0]);
        assert!(of(&["a.jpg"], &[]).unwrap_err().contains("write positions"));
    }
}
