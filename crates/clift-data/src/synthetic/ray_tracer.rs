//! A small ray tracer: nearest surface, soft shadows and occlusion in closed form, one mirrored bounce.
//!
//! Soft shadows are computed from the distance at which the ray to the lamp passes an object, not by sampling the lamp.
//! Images have no noise, and a frame is a pure function of room and camera.

use clift_core::{Camera, IntrinsicsNorm, RgbImage};
use glam::{DVec3, Vec3};

use crate::synthetic::room::{Object, Room, Shape, turned};
use crate::synthetic::tracing::noise::smooth;
use crate::synthetic::tracing::surface::Surface;

/// Smallest absolute slope of a slab test; keeps the test finite for rays along an axis.
const LEAST_SLOPE: f32 = 1e-6;
/// Smallest weight of a mirrored ray; rays of smaller weight hardly change an 8-bit value.
const LEAST_MIRROR: f32 = 0.02;
const AMBIENT: f32 = 0.6;
const LAMP: f32 = 2.2;
/// Distance over which the lamp's light halves, in units of length.
const LAMP_REACH: f32 = 2.5;
/// Inverse angular size of the lamp: larger gives sharper shadows.
const SHARPNESS: f32 = 5.0;

/// The point where a ray ends, and its surface.
struct Hit {
    point: Vec3,
    normal: Vec3,
    albedo: Vec3,
    gloss: f32,
    /// Index of the object in the room; `None` for a wall.
    object: Option<usize>,
}

impl Hit {
    fn new(point: Vec3, normal: Vec3, surface: &Surface, [u, v]: [f32; 2], object: Option<usize>) -> Self {
        Self { point, normal, albedo: surface.color(u, v, 0.0), gloss: surface.gloss, object }
    }
}

/// Renders `room` with `side * side` rays per pixel. `specular` in `[0, 1]` scales all light that depends on the view.
pub(crate) fn render(
    room: &Room,
    camera: &Camera<IntrinsicsNorm>,
    width: usize,
    height: usize,
    side: usize,
    specular: f32,
) -> RgbImage {
    let intrinsics = camera.intrinsics.to_pixels(width, height);
    let origin = camera.c2w.translation.as_vec3();
    let mut rgb = Vec::with_capacity(width * height * 3);
    for row in 0..height {
        for column in 0..width {
            let mut sum = Vec3::ZERO;
            for sample in 0..side * side {
                let offset = |index: usize| (index as f64 + 0.5) / side as f64;
                let x = (column as f64 + offset(sample % side) - intrinsics.cx) / intrinsics.fx;
                let y = (row as f64 + offset(sample / side) - intrinsics.cy) / intrinsics.fy;
                let direction = (camera.c2w.rotation * DVec3::new(x, y, 1.0)).as_vec3().normalize();
                sum += display(trace(room, origin, direction, specular, true));
            }
            let scale = 255.0 / (side * side) as f32;
            rgb.extend(sum.to_array().map(|value| (value * scale + 0.5) as u8));
        }
    }
    RgbImage { width, height, rgb }
}

/// Converts linear light to display values in `[0, 1]`: a soft shoulder, then gamma 2.
fn display(light: Vec3) -> Vec3 {
    light.map(|x| (x * (1.0 + x * 0.1) / (1.0 + x * 0.45)).clamp(0.0, 1.0).sqrt())
}

fn trace(room: &Room, origin: Vec3, direction: Vec3, specular: f32, may_mirror: bool) -> Vec3 {
    let hit = nearest(room, origin, direction);
    let to_lamp = room.lamp - hit.point;
    let distance = to_lamp.length().max(1e-3);
    let to_lamp = to_lamp * (1.0 / distance);
    let facing = hit.normal.dot(to_lamp).max(0.0);
    let reaching = if facing > 0.0 { LAMP * shadow(room, &hit, to_lamp) } else { 0.0 };
    let falloff = 1.0 / (1.0 + (distance / LAMP_REACH).powi(2));
    let diffuse = AMBIENT * openness(room, &hit) + reaching * facing * falloff;
    let mut light = hit.albedo * diffuse + lamp_glow(room, &hit);
    let shine = specular * hit.gloss;
    if shine > 0.0 {
        let mirrored = direction.reflect(hit.normal);
        let glint = mirrored.dot(to_lamp).max(0.0);
        let glint = glint.powi(8 + (hit.gloss * 40.0) as i32);
        light += Vec3::splat(shine * reaching * glint);
        // Schlick's approximation of Fresnel's law.
        let grazing = 1.0 + direction.dot(hit.normal).min(0.0);
        let weight = shine * (0.12 + 0.88 * grazing.powi(5));
        if may_mirror && weight > LEAST_MIRROR {
            let start = hit.point + hit.normal * 1e-3;
            light = light.lerp_monotonic(trace(room, start, mirrored, specular, false), weight);
        }
    }
    light
}

fn nearest(room: &Room, origin: Vec3, direction: Vec3) -> Hit {
    let mut best = (f32::INFINITY, Vec3::ZERO, None);
    for (index, object) in room.objects.iter().enumerate() {
        if let Some((distance, normal)) = meet(object, origin, direction)
            && distance < best.0
        {
            best = (distance, normal, Some(index));
        }
    }
    let (distance, normal, object) = best;
    if let Some(index) = object {
        let (point, object) = (origin + direction * distance, &room.objects[index]);
        let [u, v] = coordinates(object, point, normal);
        return Hit::new(point, normal, &object.surface, [u, v], Some(index));
    }
    meet_room(room, origin, direction)
}

fn meet(object: &Object, origin: Vec3, direction: Vec3) -> Option<(f32, Vec3)> {
    let from_center = origin - object.center;
    match object.shape {
        Shape::Ball { radius } => {
            let along = from_center.dot(direction);
            let inside = along * along - from_center.dot(from_center) + radius * radius;
            if inside < 0.0 {
                return None;
            }
            let distance = -along - inside.sqrt();
            (distance > 0.0).then(|| (distance, (from_center + direction * distance) * (1.0 / radius)))
        }
        Shape::Block { half_size, turn } => {
            let (near, far, axis, slope) = slabs(turned(from_center, turn), turned(direction, turn), half_size);
            if near > far || near <= 0.0 {
                return None;
            }
            let mut normal = Vec3::ZERO;
            normal[axis] = -slope.signum();
            Some((near, turned(normal, [turn[0], -turn[1]])))
        }
    }
}

/// Returns where a line enters and leaves a box around the origin, the axis of the entered face, and the slope there.
fn slabs(origin: Vec3, direction: Vec3, half_size: Vec3) -> (f32, f32, usize, f32) {
    let (mut near, mut far, mut entered) = (f32::NEG_INFINITY, f32::INFINITY, 0);
    for axis in 0..3 {
        let inverse = 1.0 / steep(direction[axis]);
        let (middle, reach) = (-origin[axis] * inverse, half_size[axis] * inverse.abs());
        if middle - reach > near {
            (near, entered) = (middle - reach, axis);
        }
        far = far.min(middle + reach);
    }
    (near, far, entered, direction[entered])
}

/// Limits a slope to at least [`LEAST_SLOPE`] in absolute value.
fn steep(slope: f32) -> f32 {
    if slope.abs() < LEAST_SLOPE { LEAST_SLOPE.copysign(slope) } else { slope }
}

/// Returns the coordinates of a point on an object along its surface, in the object's frame.
fn coordinates(object: &Object, point: Vec3, normal: Vec3) -> [f32; 2] {
    let local = point - object.center;
    let Shape::Block { turn, .. } = object.shape else { return [local.x + local.z, local.y] };
    let (Vec3 { x, y, z }, facing) = (turned(local, turn), turned(normal, turn));
    if facing.y.abs() > 0.5 {
        [x, z]
    } else if facing.x.abs() > 0.5 {
        [z, y]
    } else {
        [x, y]
    }
}

fn meet_room(room: &Room, origin: Vec3, direction: Vec3) -> Hit {
    let (mut distance, mut axis) = (f32::INFINITY, 0);
    for candidate in 0..3 {
        let slope = steep(direction[candidate]);
        let reached = (room.half_size[candidate].copysign(slope) - origin[candidate]) / slope;
        if reached < distance {
            (distance, axis) = (reached, candidate);
        }
    }
    let point = origin + direction * distance;
    let forward = direction[axis] > 0.0;
    let mut normal = Vec3::ZERO;
    normal[axis] = if forward { -1.0 } else { 1.0 };
    let [x, y, z] = point.to_array();
    let [u, v] = [[z, y], [x, z], [x, y]][axis];
    Hit::new(point, normal, &room.walls[axis * 2 + usize::from(forward)], [u, v], None)
}

/// Returns the visible share of the lamp: 1 without shadow, 0 in full shadow.
fn shadow(room: &Room, hit: &Hit, to_lamp: Vec3) -> f32 {
    let mut share = 1.0;
    for (index, object) in room.objects.iter().enumerate() {
        if hit.object == Some(index) {
            continue; // the normal already shades the side of a convex object that faces away from the lamp
        }
        let from_center = hit.point - object.center;
        share *= match object.shape {
            Shape::Ball { radius } => {
                let along = from_center.dot(to_lamp);
                let inside = along * along - from_center.dot(from_center) + radius * radius;
                let reached = -along - inside.max(0.0).sqrt();
                let missed_by = (radius * radius - inside).max(0.0).sqrt() - radius;
                if reached <= 0.0 { 1.0 } else { smooth(SHARPNESS * missed_by / reached) }
            }
            Shape::Block { half_size, turn } => {
                let (near, far, ..) = slabs(turned(from_center, turn), turned(to_lamp, turn), half_size);
                if far < 0.0 { 1.0 } else { smooth(1.0 + SHARPNESS * (near - far)) }
            }
        };
    }
    share
}

/// Returns the share of ambient light that reaches a point: less in corners and beside objects.
fn openness(room: &Room, hit: &Hit) -> f32 {
    let mut share = 1.0;
    for axis in 0..3 {
        let to_wall = room.half_size[axis] - hit.point[axis].abs();
        if hit.normal[axis].abs() < 0.9 {
            share *= 1.0 - 0.4 / (1.0 + (5.0 * to_wall).powi(2));
        }
    }
    for (index, object) in room.objects.iter().enumerate() {
        if hit.object == Some(index) {
            continue;
        }
        let size = match object.shape {
            Shape::Ball { radius } => radius * radius,
            Shape::Block { half_size, .. } => half_size.dot(half_size) * 0.5,
        };
        let towards = object.center - hit.point;
        let squared = towards.dot(towards).max(size);
        let covered = hit.normal.dot(towards).max(0.0) * size / (squared * squared.sqrt());
        share *= 1.0 - 0.7 * covered.min(1.0);
    }
    share
}

/// Returns the light of the lamp itself, a soft disc on the ceiling.
fn lamp_glow(room: &Room, hit: &Hit) -> Vec3 {
    if hit.object.is_some() || hit.normal.y < 0.5 {
        return Vec3::ZERO;
    }
    let across = hit.point - room.lamp;
    let squared = across.x.powi(2) + across.z.powi(2);
    Vec3::new(1.0, 0.95, 0.85) * (2.0 * smooth(1.5 - 12.0 * squared))
}
