//! Poses whose rotation block was multiplied by a number.

use std::path::Path;

use clift_core::{Camera, CameraError, DVec3, IntrinsicsNorm, Pose, plural};

/// A camera, and the scale of its rotation if it was divided out.
pub(crate) type ScaledCamera = (Camera<IntrinsicsNorm>, Option<f64>);

/// Divides the rotation of a pose by its uniform scale, and returns that scale; `None`, with the rows as they are, for a
/// valid rotation and for any other matrix.
pub(crate) fn unscaled(rows: [[f64; 4]; 3]) -> ([[f64; 4]; 3], Option<f64>) {
    if Pose::from_rows(&rows).is_ok() {
        return (rows, None);
    }
    let [x, y, z] = rows.map(|[a, b, c, _]| DVec3::new(a, b, c));
    let scale = x.dot(y.cross(z)).cbrt();
    let divided = rows.map(|[a, b, c, t]| [a / scale, b / scale, c / scale, t]);
    if scale > 0.0 && Pose::from_rows(&divided).is_ok() { (divided, Some(scale)) } else { (rows, None) }
}

/// Converts the 18 numbers of a frame as [`Camera::from_re10k`], and divides a uniform scale of the rotation out.
pub(crate) fn camera_of_row(mut row: [f64; 18]) -> Result<ScaledCamera, CameraError> {
    let error = match Camera::from_re10k(row) {
        Ok(camera) => return Ok((camera, None)),
        Err(error) => error,
    };
    let (w2c, scale) = unscaled([0, 1, 2].map(|r| [0, 1, 2, 3].map(|c| row[6 + 4 * r + c])));
    row[6..].copy_from_slice(w2c.as_flattened());
    Camera::from_re10k(row).map(|camera| (camera, scale)).map_err(|_| error)
}

/// Returns a note on the scales that were divided out of the rotations in a file; `None` for none.
pub(crate) fn note_on_scales(scales: impl Iterator<Item = f64>, path: &Path) -> Option<String> {
    let scales: Vec<f64> = scales.collect();
    let (frames, path) = (plural(scales.len(), "frame"), path.display());
    let last = scales.last()?;
    Some(format!("{frames} with a scaled rotation in {path}: the scale, {last:.3}, was divided out"))
}
