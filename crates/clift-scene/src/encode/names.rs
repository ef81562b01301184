//! Scenes and frames by their names.

use clift_data::SceneSource;

use crate::error::SceneError;

const MAX_LISTED_NAMES: usize = 8;

/// Returns the index of the scene with this key, or of the only scene.
///
/// # Errors
/// [`SceneError::BadRequest`] with the first keys.
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

/// Returns the positions of frames that are given by position or file name, with or without extension and folders. Numbers alone are
/// positions, unless one has leading zeros, as names of images have. `names` are those of all frames, in order.
///
/// # Errors
/// [`SceneError::BadRequest`] with the first names, for an unknown name.
pub fn frame_positions(frames: &[String], names: &[String]) -> Result<Vec<usize>, SceneError> {
    let frames: Vec<&str> = frames.iter().map(|frame| frame.trim()).collect();
    let is_padded = |frame: &str| frame.len() > 1 && frame.starts_with('0');
    if !frames.iter().any(|frame| is_padded(frame))
        && let Ok(positions) = frames.iter().map(|frame| frame.parse()).collect()
    {
        return Ok(positions);
    }
    let position = |&frame: &&str| {
        let frame = &frame.replace('\\', "/");
        let stem = |name: &str| name.rsplit_once('.').map_or(name.to_owned(), |(stem, _)| stem.to_owned());
        let ends = |a: &str, b: &str| a.strip_suffix(b).is_some_and(|above| above.ends_with('/'));
        let is_part = |name: &str| ends(name, frame) || ends(frame, name);
        let found = |is_named: &dyn Fn(&str) -> bool| -> Vec<usize> {
            (0..names.len()).filter(|position| is_named(&names[*position])).collect()
        };
        let is_named: [&dyn Fn(&str) -> bool; 4] =
            [&|name| name == frame, &|name| stem(name) == *frame, &is_part, &|name| is_part(&stem(name))];
        let found =
            is_named.iter().map(|is_named| found(*is_named)).find(|found| !found.is_empty()).unwrap_or_default();
        if let [first, _, ..] = found[..]
            && names[first] != *frame
            && stem(&names[first]) != *frame
        {
            let list =
                found.iter().take(MAX_LISTED_NAMES).map(|position| names[*position].as_str()).collect::<Vec<_>>();
            return Err(SceneError::request(format!(
                "--context {frame}: {} frames have this name; write one of {}",
                found.len(),
                list.join(", ")
            )));
        }
        let number = || if is_padded(frame) { None } else { frame.parse().ok() };
        found.first().copied().or_else(number).ok_or_else(|| {
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
        let positions = |frames: &[&str]| {
            let frames: Vec<String> = frames.iter().map(ToString::to_string).collect();
            let names = ["a.jpg", "b.v2.png", "7.png", "0", "003.jpg"].map(String::from);
            frame_positions(&frames, &names).map_err(|error| error.to_string())
        };
        assert_eq!(positions(&["7", "0"]).unwrap(), [7, 0], "numbers alone are positions");
        assert_eq!(positions(&["003", " 1"]).unwrap(), [4, 1], "with leading zeros, names");
        let message = positions(&["003", "001"]).unwrap_err();
        assert!(message.starts_with("--context: no frame 001; the 5 frames"), "{message}");
        assert_eq!(positions(&["b.v2.png", "a", "7.png", "2"]).unwrap(), [1, 0, 2, 2]);
        assert_eq!(
            positions(&["a.jpg", "c.jpg"]).unwrap_err(),
            "--context: no frame c.jpg; the 5 frames start with a.jpg, b.v2.png, 7.png, 0, 003.jpg"
        );
        let positions = |frame: &str| {
            let names = ["back/0000.png", "back/1.png", "front/0000.png"].map(String::from);
            frame_positions(&[frame.into()], &names).map_err(|error| error.to_string())
        };
        for frame in ["front/0000.png", "front/0000", "images/front/0000.png", "front\\0000.png"] {
            assert_eq!(positions(frame), Ok(vec![2]), "{frame}");
        }
        assert_eq!(positions("1.png"), Ok(vec![1]));
        let message = positions("0000.png").unwrap_err();
        assert!(message.ends_with("2 frames have this name; write one of back/0000.png, front/0000.png"), "{message}");
        let message = frame_positions(&["a.jpg".into()], &[]).unwrap_err().to_string();
        assert!(message.contains("write positions"), "{message}");
    }
}
