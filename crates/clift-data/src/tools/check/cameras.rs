//! Checks of intrinsics and poses without the images.

use clift_core::{Camera, IntrinsicsNorm, Pose, PoseNormalization, PoseRotation, PoseScale};

use crate::tools::check::images::Sizes;
use crate::tools::check::result::SceneCheck;

/// Plausible fields of view, in degrees.
const FOV_DEG: [f64; 2] = [5.0, 120.0];
/// Plausible principal points, over width and height.
const PRINCIPAL_POINT: [f64; 2] = [0.25, 0.75];
/// Aspect ratio of a pixel, or the inverse, above which a scene fails.
const MAX_ASPECT: f64 = 1.5;
/// Entry of `R^T R - I` above which a scene fails; files with four digits stay below.
const MAX_DEFECT: f64 = 1e-3;

pub(crate) fn check_cameras(cameras: &[Camera<IntrinsicsNorm>], sizes: &Sizes, check: &mut SceneCheck) {
    if cameras.is_empty() {
        check.reasons.push("the scene has no frames".into());
        return;
    }
    check_intrinsics(cameras, sizes, check);
    let defects = cameras.iter().map(|camera| camera.c2w.orthonormality_defect());
    let worst = defects.fold(0.0, f64::max);
    check.rotation_defect = Some(worst);
    if worst > MAX_DEFECT {
        let what = format!("rotations depart from orthonormal ones by up to {worst:.1e}, more than {MAX_DEFECT:.0e}");
        check.reasons.push(what);
    }
    let poses: Vec<Pose> = cameras.iter().map(|camera| camera.c2w).collect();
    let found = PoseNormalization::find(&check.key, &poses, &[], PoseRotation::Quaternion, PoseScale::Context);
    if let Err(error) = found {
        check.reasons.push(error.to_string());
    }
}

fn check_intrinsics(cameras: &[Camera<IntrinsicsNorm>], sizes: &Sizes, check: &mut SceneCheck) {
    let frames_where = |test: &dyn Fn(&Camera<IntrinsicsNorm>) -> bool| -> Vec<usize> {
        cameras.iter().enumerate().filter(|(_, camera)| test(camera)).map(|(frame, _)| frame).collect()
    };
    let fields = |camera: &Camera<IntrinsicsNorm>| {
        let (x, y) = camera.fov_deg();
        [x.min(y), x.max(y)]
    };
    let widest = cameras.iter().map(|camera| fields(camera)[1]).fold(0.0, f64::max);
    check.fov_deg = Some(widest);
    let [low, high] = FOV_DEG;
    let implausible = frames_where(&|camera| {
        let [narrow, wide] = fields(camera);
        !(narrow >= low && wide <= high)
    });
    if let Some(&first) = implausible.first() {
        let [narrow, wide] = fields(&cameras[first]);
        let frames = check.list_frames(&implausible);
        let what = format!("fields of view of {narrow:.1} and {wide:.1} degrees in {frames}, expected {low} to {high}");
        check.reasons.push(what);
    }
    let [low, high] = PRINCIPAL_POINT;
    let middle = low..=high;
    let outside = frames_where(&|camera| {
        let k = camera.intrinsics;
        !middle.contains(&k.cx) || !middle.contains(&k.cy)
    });
    if let Some(&first) = outside.first() {
        let k = cameras[first].intrinsics;
        let frames = check.list_frames(&outside);
        check.reasons.push(format!(
            "principal point at ({:.3}, {:.3}) of the image in {frames}, expected {low} to {high}",
            k.cx, k.cy
        ));
    }
    let aspects = cameras.iter().zip(sizes).filter_map(|(camera, size)| {
        let k = camera.intrinsics;
        size.map(|[width, height]| (k.fx * width as f64) / (k.fy * height as f64))
    });
    let off = |aspect: f64| aspect.max(1.0 / aspect);
    let Some(worst) = aspects.reduce(|a, b| if off(b) > off(a) { b } else { a }) else { return };
    if off(worst) > MAX_ASPECT {
        check.reasons.push(format!(
            "focal lengths in pixels have the ratio fx / fy = {worst:.3}: the intrinsics may belong to another image size"
        ));
    }
}
