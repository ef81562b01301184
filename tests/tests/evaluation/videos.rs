//! Videos, decoded by `ffmpeg`.

use std::path::Path;
use std::process::Command;

use clift_eval::{Canvas, Video};

use crate::support::{BINARY, Place, WHOLE, finish, skip, start};

const NO_FFMPEG: &str = "no ffmpeg on the PATH";

/// Starts a video of 10 frames per second; without `ffmpeg` the test is skipped.
fn start_video(path: &Path, width: usize, height: usize) -> Option<Video> {
    let video = Video::start(path, width, height, 10).unwrap();
    if video.is_none() {
        skip("ffmpeg", NO_FFMPEG);
    }
    video
}

/// Returns the frames of a video, decoded by `ffmpeg`.
fn decode(path: &Path, size: usize) -> Vec<Vec<u8>> {
    let output = Command::new("ffmpeg")
        .args(["-loglevel", "error", "-i"])
        .arg(path)
        .args(["-f", "rawvideo", "-pix_fmt", "rgb24", "pipe:1"])
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    output.stdout.chunks(size).map(<[u8]>::to_vec).collect()
}

#[test]
fn videos_decode_to_their_frames() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mp4");
    // A smooth image: 4:2:0 halves the resolution of colors.
    let frame = |t: usize| {
        let value = |i: usize| [i % 31 * 5 + t * 8, i / 31 * 6, 60][..].iter().map(|&v| v as u8).collect::<Vec<_>>();
        Canvas::from_rgb8(&(0..31 * 24).flat_map(value).collect::<Vec<u8>>(), 24, 31).unwrap()
    };
    let Some(mut video) = start_video(&path, 31, 24) else { return };
    for t in 0..10 {
        video.add(&frame(t)).unwrap();
    }
    assert!(!path.exists());
    video.finish().unwrap();
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "no temporary file");
    let decoded = decode(&path, 32 * 24 * 3);
    assert_eq!(decoded.len(), 10);
    for (t, decoded) in decoded.iter().enumerate() {
        let expected = frame(t);
        let differences = (0..24 * 30).flat_map(|i| {
            let (x, y) = (i % 30, i / 30);
            expected
                .pixel(x, y)
                .into_iter()
                .zip(decoded[(y * 32 + x) * 3..].iter().copied())
                .map(|(a, b)| a.abs_diff(b))
        });
        let mean = differences.map(f64::from).sum::<f64>() / (24.0 * 30.0 * 3.0);
        assert!(mean < 3.0, "frame {t}: mean difference of {mean} grey levels");
    }
}

#[test]
fn an_abandoned_video_leaves_no_file_and_a_failure_has_the_reason() {
    let folder = tempfile::tempdir().unwrap();
    let Some(mut video) = start_video(&folder.path().join("a.mp4"), 8, 8) else { return };
    video.add(&Canvas::new(8, 8, [9; 3])).unwrap();
    drop(video);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    let Some(video) = start_video(&folder.path().join("none/a.mp4"), 8, 8) else { return };
    let message = video.finish().unwrap_err().to_string();
    assert!(message.contains("No such file"), "{message}");
}

#[test]
fn video_is_written_by_ffmpeg_or_a_warning_says_why_not() {
    let place = Place::with(&WHOLE);
    place.clift("encode DIR/run --scene synthetic-0-test-00000 --out DIR/room.clift").ok();
    let render = |out: &str, change: fn(&mut Command)| {
        let mut command = Command::new(BINARY);
        command.args(["render", "room.clift", "--path", "orbit", "--frames", "3", "--video", "orbit.mp4", "-o", out]);
        command.current_dir(place.at(""));
        change(&mut command);
        finish(start(&mut command))
    };
    render("a", |command| _ = command.env("PATH", "")).ok().notes("warning: no `ffmpeg` on the PATH");
    assert!(!place.at("orbit.mp4").exists() && place.at("a/animation.png").exists());
    if Command::new("ffmpeg").arg("-version").output().is_err() {
        return skip("ffmpeg", NO_FFMPEG);
    }
    render("b", |_| ()).ok();
    assert_eq!(&place.bytes("orbit.mp4")[4..8], b"ftyp");
    render("c", |_| ()).fails_with(2, &["orbit.mp4 exists; replace it with --force"]);
}
