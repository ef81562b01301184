//! MP4 videos, through the program `ffmpeg`.

use std::io::{ErrorKind, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use clift_core::TEMPORARY;

use crate::error::EvalError;
use crate::figures::canvas::Canvas;

/// Writer of an H.264 video, frame by frame. The file appears under its name after [`Video::finish`].
#[derive(Debug)]
pub struct Video {
    path: PathBuf,
    temporary: PathBuf,
    ffmpeg: Child,
}

impl Video {
    /// Starts a video of `width` by `height` pixels at `fps` frames per second; `None` without `ffmpeg` on the PATH.
    ///
    /// A side with an odd number of pixels gets one black row or column more, which the format demands.
    pub fn start(path: &Path, width: usize, height: usize, fps: u16) -> Result<Option<Self>, EvalError> {
        let temporary = path.with_file_name(format!("{TEMPORARY}{}.mp4", std::process::id()));
        let mut command = Command::new("ffmpeg");
        command.args(["-loglevel", "error", "-nostdin", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24"]);
        command.arg("-s").arg(format!("{width}x{height}")).arg("-r").arg(fps.to_string()).args(["-i", "pipe:0"]);
        // Browsers play 4:2:0 with BT.709 colors; the index at the front lets them start before the end is loaded.
        command.args(["-vf", "scale=out_color_matrix=bt709:out_range=tv,pad=ceil(iw/2)*2:ceil(ih/2)*2"]);
        command.args(["-c:v", "libx264", "-preset", "slow", "-crf", "14", "-pix_fmt", "yuv420p"]);
        command.args([
            "-colorspace",
            "bt709",
            "-color_primaries",
            "bt709",
            "-color_trc",
            "bt709",
            "-color_range",
            "tv",
        ]);
        command.args(["-movflags", "+faststart"]).arg(&temporary);
        let started = command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn();
        match started {
            Ok(ffmpeg) => Ok(Some(Self { path: path.into(), temporary, ffmpeg })),
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
            Err(error) => Err(EvalError::io("starting ffmpeg for the video", path)(error)),
        }
    }

    /// Adds the next frame.
    ///
    /// # Errors
    /// [`EvalError::Io`] with the message of `ffmpeg` if it ended.
    pub fn add(&mut self, image: &Canvas) -> Result<(), EvalError> {
        let written = self.ffmpeg.stdin.as_mut().map_or(Ok(()), |stdin| stdin.write_all(image.as_rgb8()));
        written.map_err(|error| self.failed(error))
    }

    /// Completes the file and moves it to its name.
    ///
    /// # Errors
    /// [`EvalError::Io`] with the message of `ffmpeg`, or for a file that cannot be renamed.
    pub fn finish(mut self) -> Result<(), EvalError> {
        drop(self.ffmpeg.stdin.take());
        let status = self.ffmpeg.wait().map_err(EvalError::io("writing the video", &self.path))?;
        if !status.success() {
            return Err(self.failed(std::io::Error::other(format!("ffmpeg ended with {status}"))));
        }
        std::fs::rename(&self.temporary, &self.path).map_err(EvalError::io("writing the video", &self.path))
    }

    /// Prefers the message of `ffmpeg` to that of the broken pipe.
    fn failed(&mut self, error: std::io::Error) -> EvalError {
        drop(self.ffmpeg.stdin.take());
        drop(self.ffmpeg.wait());
        let mut text = String::new();
        if let Some(mut stderr) = self.ffmpeg.stderr.take() {
            drop(stderr.read_to_string(&mut text));
        }
        // A full disk has a line of its own before the last.
        let full = text.lines().find(|line| line.contains("No space left"));
        let last = full.or_else(|| text.lines().rev().find(|line| !line.trim().is_empty()));
        let error = last.map_or(error, |line| std::io::Error::other(line.trim().to_owned()));
        EvalError::io("writing the video", &self.path)(error)
    }
}

impl Drop for Video {
    fn drop(&mut self) {
        // Nothing to do after `finish`: the process has ended and the file has its name.
        drop(self.ffmpeg.kill());
        drop(self.ffmpeg.wait());
        drop(std::fs::remove_file(&self.temporary));
    }
}
