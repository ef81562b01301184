//! Normalization, context views and groups of a coded scene file.
// V context views

use clift_core::{Camera, DMat3, Pose, PoseNormalization};
use glam::DQuat;

use crate::scene::scene::{ContextGroup, split_groups};
use crate::tensors::{f32_bytes, f64_bytes, numbers};

/// Bytes of the normalization: rotation; center and scale in f64, for worlds of any size.
const WORLD_BYTES: usize = 4 * 4 + 4 * 8;
/// Bytes of a view: rotation, center and frame number.
const VIEW_BYTES: usize = 8 * 4;
const INTRINSICS_BYTES: usize = 4 * 4;

/// Adds the normalization. As in the views, a rotation is stored as a unit quaternion: what is not orthonormal in its matrix,
/// up to the tolerance of the check, is lost.
pub(crate) fn write_world(world: &PoseNormalization, body: &mut Vec<u8>) {
    body.extend(narrow(&quaternion(world.mean_c2w)));
    let [x, y, z] = world.mean_c2w.translation.to_array();
    body.extend(f64_bytes([x, y, z, world.scale]));
}

/// Reads the normalization; returns it and the rest of the bytes. `None` if there are too few bytes.
pub(crate) fn read_world(bytes: &[u8]) -> Option<(PoseNormalization, &[u8])> {
    let (bytes, rest) = bytes.split_at_checked(WORLD_BYTES)?;
    let values = numbers(&bytes[16..], f64::from_le_bytes);
    let [x, y, z, scale] = std::array::from_fn(|i| values[i]);
    Some((PoseNormalization { mean_c2w: pose(floats(bytes), [x, y, z]), scale }, rest))
}

/// Adds the number of intrinsics, which is 1 if those of all views are equal, the intrinsics, and the views.
pub(crate) fn write_views(context: &[Camera], frames: &[u32], body: &mut Vec<u8>) {
    let intrinsics: Vec<Vec<u8>> = context.iter().map(|camera| narrow(&camera.intrinsics.to_array())).collect();
    let count = if intrinsics.windows(2).all(|pair| pair[0] == pair[1]) { 1 } else { intrinsics.len() };
    body.extend((count as u32).to_le_bytes());
    body.extend(intrinsics[..count].concat());
    for (camera, frame) in context.iter().zip(frames) {
        body.extend(narrow(&quaternion(camera.c2w)));
        body.extend(narrow(&camera.c2w.translation.to_array()));
        body.extend(frame.to_le_bytes());
    }
}

type Views = (Vec<Camera>, Vec<u32>);

/// Reads `views` views; returns cameras, frame numbers and the rest of the bytes. `None` if there are too few bytes.
pub(crate) fn read_views(views: usize, bytes: &[u8]) -> Option<(Views, &[u8])> {
    let (count, bytes) = bytes.split_first_chunk::<4>()?;
    let count = u32::from_le_bytes(*count) as usize;
    if count != 1 && count != views {
        return None;
    }
    let (intrinsics, bytes) = bytes.split_at_checked(count.checked_mul(INTRINSICS_BYTES)?)?;
    let intrinsics: Vec<[f64; 4]> = intrinsics.chunks_exact(INTRINSICS_BYTES).map(floats).collect();
    let (bytes, rest) = bytes.split_at_checked(views.checked_mul(VIEW_BYTES)?)?;
    let view = |(i, bytes): (usize, &[u8])| {
        let c2w = pose(floats(bytes), floats(&bytes[16..]));
        let frame = u32::from_le_bytes(bytes[VIEW_BYTES - 4..].try_into().expect("the last 4 bytes of a view"));
        (Camera { c2w, intrinsics: intrinsics[i.min(count - 1)].into() }, frame)
    };
    Some((bytes.chunks_exact(VIEW_BYTES).enumerate().map(view).unzip(), rest))
}

/// Adds the number of groups, their sizes and their views, padded to words of four bytes, and the frames of several groups: that
/// of a single group is the frame of the scene.
pub(crate) fn write_groups(groups: &[ContextGroup], body: &mut Vec<u8>) {
    let start = body.len();
    let sizes = groups.iter().map(|group| group.views.len() as u32);
    let views = groups.iter().flat_map(|group| group.views.iter().copied());
    let numbers = std::iter::once(groups.len() as u32).chain(sizes).chain(views);
    body.extend(numbers.flat_map(|number| (number as u16).to_le_bytes()));
    body.resize(start + (body.len() - start).next_multiple_of(4), 0);
    if groups.len() > 1 {
        for group in groups {
            write_world(&group.frame, body);
        }
    }
}

/// Reads groups; returns them and the rest of the bytes. `None` if there are too few bytes.
pub(crate) fn read_groups(bytes: &[u8]) -> Option<(Vec<ContextGroup>, &[u8])> {
    let numbers = |bytes: &[u8]| numbers(bytes, |number| u32::from(u16::from_le_bytes(number)));
    let (count, rest) = bytes.split_first_chunk::<2>()?;
    let (sizes, rest) = rest.split_at_checked(2 * usize::from(u16::from_le_bytes(*count)))?;
    let sizes = numbers(sizes);
    let members: usize = sizes.iter().map(|&size| size as usize).sum();
    let (views, _) = rest.split_at_checked(2 * members)?;
    let end = (2 * (1 + sizes.len() + members)).next_multiple_of(4);
    let mut rest = bytes.get(end..)?;
    let groups = split_groups(&sizes, &numbers(views)).ok()?;
    if let [views] = &groups[..] {
        return Some((vec![ContextGroup { views: views.clone(), ..ContextGroup::of_all(0) }], rest));
    }
    let mut framed = Vec::with_capacity(groups.len());
    for views in groups {
        let (frame, others) = read_world(rest)?;
        framed.push(ContextGroup { views, frame });
        rest = others;
    }
    Some((framed, rest))
}

/// Returns the pose of a quaternion and a center. That of damaged numbers contains NaN, which the check of the scene finds.
fn pose(quaternion: [f64; 4], center: [f64; 3]) -> Pose {
    Pose { rotation: DMat3::from_quat(DQuat::from_array(quaternion).normalize()), translation: center.into() }
}

fn quaternion(c2w: Pose) -> [f64; 4] {
    DQuat::from_mat3(&c2w.rotation).to_array()
}

fn narrow(values: &[f64]) -> Vec<u8> {
    f32_bytes(values.iter().map(|value| *value as f32))
}

fn floats<const N: usize>(bytes: &[u8]) -> [f64; N] {
    let values = bytes.as_chunks::<4>().0;
    std::array::from_fn(|i| f64::from(f32::from_le_bytes(values[i])))
}
