//! Scenes with correct cameras pass, scenes with wrong cameras fail.

use std::sync::OnceLock;

use clift_core::{Camera, IntrinsicsNorm, Pose, RgbImage};
use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::*;
use crate::error::DataError;
use crate::testing::{self, TestSource};
use crate::tools::check::result::Verdict;

/// A room with fine patterns, seen from nearby as in a video.
fn room() -> &'static (Vec<Camera<IntrinsicsNorm>>, Vec<RgbImage>) {
    static ROOM: OnceLock<(Vec<Camera<IntrinsicsNorm>>, Vec<RgbImage>)> = OnceLock::new();
    ROOM.get_or_init(|| {
        let source = testing::rooms(|c| {
            (c.num_frames, c.width, c.height) = (12, 320, 240);
            (c.path_length, c.texture_frequency, c.specular) = (1.2, 3.0, 0.1);
        });
        let frames = (0..12).into_par_iter().map(|frame| source.frame(0, frame).unwrap()).collect();
        (source.cameras(0).unwrap(), frames)
    })
}

/// Checks the room with other cameras and frames.
fn check_changed(
    change: impl Fn(usize, &mut Camera<IntrinsicsNorm>) + Send + Sync + 'static,
    shown: impl Fn(usize) -> Option<usize> + Send + Sync + 'static,
) -> SceneCheck {
    let source = TestSource {
        base: Box::new(testing::rooms(|_| ())),
        cameras: Box::new(move |_, _| {
            let mut cameras = room().0.clone();
            cameras.iter_mut().enumerate().for_each(|(frame, camera)| change(frame, camera));
            Ok(cameras)
        }),
        frame: Box::new(move |_, _, frame| {
            let torn = || DataError::BadImage { key: "k".into(), frame, what: "it is torn".into() };
            shown(frame).map(|shown| room().1[shown].clone()).ok_or_else(torn)
        }),
    };
    check_scene(&source, 0)
}

fn check(change: impl Fn(usize, &mut Camera<IntrinsicsNorm>) + Send + Sync + 'static) -> SceneCheck {
    check_changed(change, Some)
}

/// Turns a camera up or down. The path leads sideways, so a sideways turn moves points along their epipolar lines.
fn turned(c2w: Pose, angle_deg: f64) -> Pose {
    c2w.after(Pose { rotation: DMat3::from_rotation_x(angle_deg.to_radians()), ..Pose::IDENTITY })
}

#[test]
fn cameras_that_contradict_the_images_are_flagged() {
    let right = check(|_, _| ());
    assert!(right.verdict == Verdict::Ok && right.reasons.is_empty(), "{right:?}");
    assert_eq!((right.num_frames, right.image_size), (12, Some([320, 240])));
    assert!(right.epipolar_px.is_some_and(|px| px < 0.7) && right.pairs.len() >= 5, "{right:?}");
    let flagged = |check: SceneCheck| {
        assert!(check.verdict == Verdict::Flagged && check.epipolar_px.is_some_and(|px| px > 1.0), "{check:?}");
        assert!(check.reasons[0].contains("from their epipolar lines"), "{check:?}");
    };
    // A degree of a focal length of 417 pixels, at 640 columns, is 7 pixels.
    let angle_deg = |frame: usize| 0.8 * ((frame * 7919 % 13) as f64 / 6.0 - 1.0);
    flagged(check(move |frame, camera| camera.c2w = turned(camera.c2w, angle_deg(frame))));
    flagged(check(|_, camera| camera.intrinsics.fx *= 1.25));
    flagged(check_changed(|_, _| (), |frame| Some((frame * 5 + 2) % 12)));
}

#[test]
fn usual_mistakes_are_named() {
    let named = |check: SceneCheck, expected: &str| {
        let text = check.reasons.join("; ");
        assert!(text.contains(&format!("the images fit better with {expected}")), "{expected}: {text}");
        assert!(check.frames.is_empty());
    };
    let opposite = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    named(check(move |_, camera| camera.c2w.rotation *= opposite), "the y and z axes of every camera reversed");
    named(check(|_, camera| camera.c2w = camera.c2w.inverse()), "every pose inverted (");
    let view_matrix = move |_: usize, camera: &mut Camera<IntrinsicsNorm>| {
        camera.c2w.rotation *= opposite;
        camera.c2w = camera.c2w.inverse();
    };
    named(check(view_matrix), "every pose inverted, then its y and z axes reversed");
    for (scale, expected) in [(1.1, "focal lengths times 0.9"), (0.9, "focal lengths times 1.1")] {
        let scaled = move |_: usize, camera: &mut Camera<IntrinsicsNorm>| {
            camera.intrinsics.fx *= scale;
            camera.intrinsics.fy *= scale;
        };
        named(check(scaled), expected);
    }
    named(
        check(|_, camera| camera.c2w = turned(camera.c2w, 4.0)),
        "every camera turned by 4 degrees about its own axis (-1, 0, 0)",
    );
}

#[test]
fn exchanged_neighbours_and_single_cameras_are_named() {
    let original = &room().0;
    for first in [2, 4, 9] {
        let exchanged = check(move |frame, camera| {
            if frame == first || frame == first + 1 {
                camera.c2w = original[2 * first + 1 - frame].c2w;
            }
        });
        assert_eq!(exchanged.reasons.len(), 1, "{exchanged:?}");
        let expected = format!("the cameras of frames {first} and {} are exchanged: ", first + 1);
        assert!(exchanged.reasons[0].starts_with(&expected), "{exchanged:?}");
    }
    // A sideways turn on a sideways path: the epipolar lines stay.
    for (wrong, angle_deg) in [(2, 2.0), (9, -2.0), (11, 2.0)] {
        let single = check(move |frame, camera| {
            if frame == wrong {
                camera.c2w.rotation *= DMat3::from_rotation_y(f64::to_radians(angle_deg));
            }
        });
        assert_eq!(single.reasons.len(), 1, "{single:?}");
        let expected = format!("the cameras of 1 frame ({wrong}) do not fit the other frames");
        assert!(single.reasons[0].starts_with(&expected), "{single:?}");
        assert!(single.frames.len() >= 8, "{single:?}");
    }
}

#[test]
fn implausible_cameras_fail_with_the_reason() {
    let reasons = |check: SceneCheck| {
        assert_eq!(check.verdict, Verdict::Flagged);
        check.reasons.join("; ")
    };
    let text = reasons(check(|_, camera| camera.intrinsics.cx = 0.9));
    assert!(text.contains("principal point at (0.900, 0.500) of the image in 12 frames (0, 1, 2, 3, 4, ..)"), "{text}");
    let text = reasons(check(|frame, camera| {
        if frame == 3 {
            camera.intrinsics.fx = 0.2;
        }
    }));
    assert!(text.contains("degrees in 1 frame (3), expected 5 to 120"), "{text}");
    let text = reasons(check(|_, camera| camera.intrinsics.fy *= 2.0));
    assert!(text.contains("fx / fy = 0.500: the intrinsics may belong to another image size"), "{text}");
    let text = reasons(check(|frame, camera| camera.c2w.rotation.x_axis.x += 0.004 * f64::from(frame == 5)));
    assert!(text.contains("depart from orthonormal ones by up to"), "{text}");
    let text = reasons(check(|_, camera| camera.c2w.translation = DVec3::new(1.0, 2.0, 3.0)));
    assert!(text.contains("has no baseline"), "{text}");
}

#[test]
fn repeated_and_unreadable_frames_are_reported() {
    let stuck = check_changed(|_, _| (), |frame| Some(frame.min(9)));
    let repeated = "2 frames (10, 11) repeat the image of an earlier frame that has another camera";
    assert!(stuck.verdict == Verdict::Flagged && stuck.reasons.contains(&repeated.to_owned()), "{stuck:?}");
    let torn = check_changed(|_, _| (), |frame| (frame != 2).then_some(frame));
    let expected = "1 frame (2) cannot be read; the first: frame 2 of scene k cannot";
    assert!(torn.reasons[0].starts_with(expected), "{torn:?}");
    // Images too small for corners add a note, no error.
    let small = check_scene(&testing::rooms(|c| (c.num_frames, c.width, c.height) = (8, 48, 32)), 0);
    assert!(small.verdict == Verdict::NotCompared && small.epipolar_px.is_none(), "{small:?}");
    let expected = "poses were not compared with the images: only 0 matching corners";
    assert!(small.notes[0].starts_with(expected), "{small:?}");
}

#[test]
fn skipped_scenes_fail_with_the_reason() {
    let mut report = SkipReport::new(3);
    report.skip("a", "not a scene");
    for name in ["0005.jpg", "0010.jpg"] {
        report.skip_frame("b", name, "no such file");
    }
    let checks = skipped_scenes(&report);
    assert_eq!(checks.len(), 1);
    assert!(checks[0].verdict == Verdict::Flagged && checks[0].key == "a" && checks[0].reasons == ["not a scene"]);
    assert!(checks[0].notes.is_empty());
    let mut check = SceneCheck { key: "b".into(), ..SceneCheck::default() };
    note_skipped_frames(&report, &mut check);
    assert!(check.reasons.is_empty());
    assert_eq!(check.notes, ["2 frames skipped, no such file: 0005.jpg, 0010.jpg"]);
}
