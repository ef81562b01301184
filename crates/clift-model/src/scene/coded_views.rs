//! The context views of a coded scene file.
// V context views

use glam::{DMat3, DMat4, DQuat, DVec3};

use crate::scene::scene::CODED_VERSION;
use crate::views::camera::ViewCamera;

/// Bytes of a view in version 3: three rows of the pose, `fx, fy, cx, cy`, and the frame number.
const FORMER_VIEW_BYTES: usize = 17 * 4;
/// Bytes of a view: rotation, center and frame number.
const VIEW_BYTES: usize = 8 * 4;
const INTRINSICS_BYTES: usize = 4 * 4;

/// Adds the number of intrinsics, which is 1 if those of all views are equal, the intrinsics, and the views. A rotation is
/// stored as a unit quaternion: what is not orthonormal in its matrix, up to the tolerance of the check, is lost.
pub(crate) fn write_views(context: &[ViewCamera], frames: &[u32], body: &mut Vec<u8>) {
    let intrinsics: Vec<[f32; 4]> = context.iter().map(|camera| camera.intrinsics.map(|value| value as f32)).collect();
    let count = if intrinsics.windows(2).all(|pair| pair[0] == pair[1]) { 1 } else { intrinsics.len() };
    body.extend((count as u32).to_le_bytes());
    body.extend(intrinsics[..count].iter().flatten().flat_map(|value| value.to_le_bytes()));
    for (camera, frame) in context.iter().zip(frames) {
        let rotation = DQuat::from_mat3(&DMat3::from_mat4(DMat4::from_cols_array(&camera.c2w).transpose()));
        let values = rotation.to_array().into_iter().chain(camera.origin());
        body.extend(values.flat_map(|value| (value as f32).to_le_bytes()));
        body.extend(frame.to_le_bytes());
    }
}

/// Cameras and frame numbers.
type Views = (Vec<ViewCamera>, Vec<u32>);

/// Reads `views` views of a file of this version; returns cameras, frame numbers and the rest of the bytes. `None` if there
/// are too few bytes.
pub(crate) fn read_views<'a>(version: &str, views: usize, bytes: &'a [u8]) -> Option<(Views, &'a [u8])> {
    if version != CODED_VERSION {
        let (bytes, rest) = bytes.split_at_checked(views.checked_mul(FORMER_VIEW_BYTES)?)?;
        return Some((bytes.chunks_exact(FORMER_VIEW_BYTES).map(former_view).unzip(), rest));
    }
    let (count, bytes) = bytes.split_first_chunk::<4>()?;
    let count = u32::from_le_bytes(*count) as usize;
    if count != 1 && count != views {
        return None;
    }
    let (intrinsics, bytes) = bytes.split_at_checked(count.checked_mul(INTRINSICS_BYTES)?)?;
    let intrinsics: Vec<[f64; 4]> = intrinsics.chunks_exact(INTRINSICS_BYTES).map(floats).collect();
    let (bytes, rest) = bytes.split_at_checked(views.checked_mul(VIEW_BYTES)?)?;
    let view = |(i, bytes): (usize, &[u8])| {
        // Of damaged numbers the pose contains NaN, which the check of the scene finds.
        let rotation = DQuat::from_array(floats(bytes)).normalize();
        let pose = DMat4::from_rotation_translation(rotation, DVec3::from_array(floats(&bytes[16..])));
        let camera = ViewCamera { c2w: pose.transpose().to_cols_array(), intrinsics: intrinsics[i.min(count - 1)] };
        (camera, frame(bytes))
    };
    Some((bytes.chunks_exact(VIEW_BYTES).enumerate().map(view).unzip(), rest))
}

fn former_view(bytes: &[u8]) -> (ViewCamera, u32) {
    let mut c2w = [0.0; 16];
    c2w[..12].copy_from_slice(&floats::<12>(bytes));
    c2w[15] = 1.0;
    (ViewCamera { c2w, intrinsics: floats(&bytes[48..]) }, frame(bytes))
}

/// Returns the first numbers of bytes.
fn floats<const N: usize>(bytes: &[u8]) -> [f64; N] {
    let values = bytes.as_chunks::<4>().0;
    std::array::from_fn(|i| f64::from(f32::from_le_bytes(values[i])))
}

/// Returns the frame number, which is the last of a view.
fn frame(view: &[u8]) -> u32 {
    view.last_chunk::<4>().map_or(0, |bytes| u32::from_le_bytes(*bytes))
}
