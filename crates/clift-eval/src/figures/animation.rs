//! Animated PNG. Browsers play the file; other programs show the first frame.

use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use crate::error::EvalError;
use crate::figures::canvas::Canvas;

/// Writer of an animation, frame by frame. The file is complete after [`Animation::finish`].
pub struct Animation {
    path: PathBuf,
    writer: png::Writer<BufWriter<File>>,
}

impl Animation {
    /// Starts a looping animation of `num_frames` images of `width` by `height` pixels at `fps` frames per second.
    pub fn new(path: &Path, width: usize, height: usize, num_frames: usize, fps: u16) -> Result<Self, EvalError> {
        let file = BufWriter::new(File::create(path).map_err(EvalError::io("writing the animation", path))?);
        let mut encoder = png::Encoder::new(file, width as u32, height as u32);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        // Refuses more or fewer frames than the header states.
        encoder.validate_sequence(true);
        let started = encoder
            .set_animated(num_frames as u32, 0)
            .and_then(|()| encoder.set_frame_delay(1, fps))
            .and_then(|()| encoder.write_header());
        let writer = started.map_err(|error| failed(path, error))?;
        Ok(Self { path: path.into(), writer })
    }

    /// Adds the next frame.
    pub fn add(&mut self, image: &Canvas) -> Result<(), EvalError> {
        self.writer.write_image_data(image.as_rgb8()).map_err(|error| failed(&self.path, error))
    }

    /// Completes the file.
    pub fn finish(self) -> Result<(), EvalError> {
        self.writer.finish().map_err(|error| failed(&self.path, error))
    }
}

fn failed(path: &Path, error: png::EncodingError) -> EvalError {
    EvalError::io("encoding the animation", path)(std::io::Error::other(error))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_read_back_with_their_delay_and_are_as_many_as_announced() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let start = |num_frames| Animation::new(&path, 5, 3, num_frames, 12);
        let colours = [[255, 0, 0], [0, 255, 0], [10, 20, 30]];
        let mut animation = start(3).unwrap();
        for colour in colours {
            animation.add(&Canvas::new(5, 3, colour)).unwrap();
        }
        animation.finish().unwrap();
        let file = std::io::BufReader::new(File::open(&path).unwrap());
        let mut reader = png::Decoder::new(file).read_info().unwrap();
        let control = *reader.info().animation_control().unwrap();
        assert_eq!((control.num_frames, control.num_plays), (3, 0));
        for colour in colours {
            let mut pixels = vec![0; 5 * 3 * 3];
            reader.next_frame(&mut pixels).unwrap();
            assert!(pixels.chunks(3).all(|pixel| pixel == colour), "{pixels:?}");
            let frame = reader.info().frame_control().unwrap();
            assert_eq!((frame.delay_num, frame.delay_den), (1, 12));
        }
        let mut animation = start(2).unwrap();
        animation.add(&Canvas::new(5, 3, [0; 3])).unwrap();
        assert!(animation.add(&Canvas::new(4, 3, [0; 3])).is_err(), "another size");
        assert!(animation.finish().is_err(), "one frame of two");
        assert!(start(0).is_err());
    }
}
