//! A small ray tracer: nearest surface, soft shadows and occlusion in closed form, one mirrored bounce.
//!
//! Soft shadows come from how closely the ray to the lamp passes an object, not from sampling the lamp, so
//! pictures have no noise and a frame is a pure function of scene and camera.

use super::scene::{Object, Scene, Shape};
use super::vector::Vector;
use crate::camera::Camera;
use crate::clip::Frame;

/// Keeps slab tests finite for rays along an axis.
const LEAST_SLOPE: f32 = 1e-6;
/// Below this weight a mirrored ray changes no 8-bit value worth its cost.
const LEAST_MIRROR: f32 = 0.02;
/// Light that arrives from everywhere, relative to the lamp's.
const AMBIENT: f32 = 0.6;
/// Brightness of the lamp.
const LAMP: f32 = 2.2;
/// Distance over which the lamp's light halves, in units of length.
const LAMP_REACH: f32 = 2.5;
/// Inverse angular size of the lamp: larger gives sharper shadows.
const SHARPNESS: f32 = 5.0;

/// Where a ray ends.
struct Hit {
    point: Vector,
    normal: Vector,
    albedo: Vector,
    gloss: f32,
    /// Position in the scene's list of what was hit, unless it is the room.
    object: Option<usize>,
}

/// Renders `scene` with `side * side` rays per pixel.
///
/// `specular` in `[0, 1]` scales everything that depends on the direction a surface is seen from.
pub(super) fn render(scene: &Scene, camera: &Camera, width: usize, height: usize, side: usize, specular: f32) -> Frame {
    let intrinsics = camera.intrinsics_norm.to_pixels(width, height);
    let origin = Vector::from_f64(camera.c2w.translation);
    let mut rgb = Vec::with_capacity(width * height * 3);
    for row in 0..height {
        for column in 0..width {
            let mut sum = Vector::ZERO;
            for sample in 0..side * side {
                let offset = |index: usize| (index as f64 + 0.5) / side as f64;
                let x = (column as f64 + offset(sample % side) - intrinsics.cx) / intrinsics.fx;
                let y = (row as f64 + offset(sample / side) - intrinsics.cy) / intrinsics.fy;
                let direction = Vector::from_f64(camera.c2w.rotate([x, y, 1.0])).unit();
                sum = sum + display(trace(scene, origin, direction, specular, true));
            }
            let scale = 255.0 / (side * side) as f32;
            rgb.extend(sum.0.map(|value| (value * scale + 0.5) as u8));
        }
    }
    Frame { width, height, rgb }
}

/// Linear light to display values in `[0, 1]`: a soft shoulder, then gamma 2.
fn display(light: Vector) -> Vector {
    Vector(light.0.map(|x| (x * (1.0 + x * 0.1) / (1.0 + x * 0.45)).clamp(0.0, 1.0).sqrt()))
}

/// Light that comes back along a ray.
fn trace(scene: &Scene, origin: Vector, direction: Vector, specular: f32, may_mirror: bool) -> Vector {
    let hit = nearest(scene, origin, direction);
    let to_lamp = scene.lamp - hit.point;
    let distance = to_lamp.length().max(1e-3);
    let to_lamp = to_lamp * (1.0 / distance);
    let facing = hit.normal.dot(to_lamp).max(0.0);
    let reaching = if facing > 0.0 { LAMP * shadow(scene, &hit, to_lamp) } else { 0.0 };
    let falloff = 1.0 / (1.0 + (distance / LAMP_REACH).powi(2));

    let diffuse = AMBIENT * openness(scene, &hit) + reaching * facing * falloff;
    let mut light = hit.albedo * diffuse + lamp_glow(scene, &hit);
    let shine = specular * hit.gloss;
    if shine > 0.0 {
        let mirrored = direction.mirrored(hit.normal);
        let glint = mirrored.dot(to_lamp).max(0.0);
        let glint = glint.powi(8 + (hit.gloss * 40.0) as i32);
        light = light + Vector::ONE * (shine * reaching * glint);
        // Schlick's approximation of Fresnel's law.
        let grazing = 1.0 + direction.dot(hit.normal).min(0.0);
        let weight = shine * (0.12 + 0.88 * grazing.powi(5));
        if may_mirror && weight > LEAST_MIRROR {
            let start = hit.point + hit.normal * 1e-3;
            light = light.mix(trace(scene, start, mirrored, specular, false), weight);
        }
    }
    light
}

fn nearest(scene: &Scene, origin: Vector, direction: Vector) -> Hit {
    let mut best = (f32::INFINITY, Vector::ZERO, None);
    for (index, object) in scene.objects.iter().enumerate() {
        if let Some((distance, normal)) = meet(object, origin, direction)
            && distance < best.0
        {
            best = (distance, normal, Some(index));
        }
    }
    let (distance, normal, object) = best;
    if let Some(index) = object {
        let (point, object) = (origin + direction * distance, &scene.objects[index]);
        let [u, v] = surface(object, point, normal);
        return Hit { point, normal, albedo: object.texture.color(u, v), gloss: object.gloss, object: Some(index) };
    }
    meet_room(scene, origin, direction)
}

/// Distance and normal where a ray from outside meets an object.
fn meet(object: &Object, origin: Vector, direction: Vector) -> Option<(f32, Vector)> {
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
            let (near, far, axis, slope) = slabs(from_center.turned(turn), direction.turned(turn), half_size);
            if near > far || near <= 0.0 {
                return None;
            }
            let mut normal = Vector::ZERO;
            normal.0[axis] = -slope.signum();
            Some((near, normal.turned([turn[0], -turn[1]])))
        }
    }
}

/// Where a line enters and leaves a box around the origin, the axis it enters through and its slope there.
fn slabs(origin: Vector, direction: Vector, half_size: Vector) -> (f32, f32, usize, f32) {
    let (mut near, mut far, mut entered) = (f32::NEG_INFINITY, f32::INFINITY, 0);
    for axis in 0..3 {
        let inverse = 1.0 / steep(direction.0[axis]);
        let (middle, reach) = (-origin.0[axis] * inverse, half_size.0[axis] * inverse.abs());
        if middle - reach > near {
            (near, entered) = (middle - reach, axis);
        }
        far = far.min(middle + reach);
    }
    (near, far, entered, direction.0[entered])
}

/// Moves a slope off zero.
fn steep(slope: f32) -> f32 {
    if slope.abs() < LEAST_SLOPE { LEAST_SLOPE.copysign(slope) } else { slope }
}

/// Texture coordinates of a point on an object: those of the object's own frame along the face.
fn surface(object: &Object, point: Vector, normal: Vector) -> [f32; 2] {
    let local = point - object.center;
    let Shape::Block { turn, .. } = object.shape else { return [local.0[0] + local.0[2], local.0[1]] };
    let ([x, y, z], facing) = (local.turned(turn).0, normal.turned(turn).0);
    if facing[1].abs() > 0.5 {
        [x, z]
    } else if facing[0].abs() > 0.5 {
        [z, y]
    } else {
        [x, y]
    }
}

/// Where a ray from inside the room meets its walls.
fn meet_room(scene: &Scene, origin: Vector, direction: Vector) -> Hit {
    let (mut distance, mut axis) = (f32::INFINITY, 0);
    for candidate in 0..3 {
        let slope = steep(direction.0[candidate]);
        let reached = (scene.half_size.0[candidate].copysign(slope) - origin.0[candidate]) / slope;
        if reached < distance {
            (distance, axis) = (reached, candidate);
        }
    }
    let point = origin + direction * distance;
    let forward = direction.0[axis] > 0.0;
    let mut normal = Vector::ZERO;
    normal.0[axis] = if forward { -1.0 } else { 1.0 };
    let [x, y, z] = point.0;
    let [u, v] = [[z, y], [x, z], [x, y]][axis];
    let albedo = scene.walls[axis * 2 + usize::from(forward)].color(u, v);
    let is_floor = axis == 1 && forward;
    Hit { point, normal, albedo, gloss: if is_floor { 0.35 } else { 0.0 }, object: None }
}

/// Share of the lamp that is seen from a point: 1 in the open, 0 in full shadow.
fn shadow(scene: &Scene, hit: &Hit, to_lamp: Vector) -> f32 {
    let mut share = 1.0;
    for (index, object) in scene.objects.iter().enumerate() {
        if hit.object == Some(index) {
            continue; // a convex thing shades itself by turning away from the lamp
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
                let (near, far, ..) = slabs(from_center.turned(turn), to_lamp.turned(turn), half_size);
                if far < 0.0 { 1.0 } else { smooth(1.0 + SHARPNESS * (near - far)) }
            }
        };
    }
    share
}

/// Share of the surroundings that light a point: less in corners and beside objects.
fn openness(scene: &Scene, hit: &Hit) -> f32 {
    let mut share = 1.0;
    for axis in 0..3 {
        let to_wall = scene.half_size.0[axis] - hit.point.0[axis].abs();
        if hit.normal.0[axis].abs() < 0.9 {
            share *= 1.0 - 0.4 / (1.0 + (5.0 * to_wall).powi(2));
        }
    }
    for (index, object) in scene.objects.iter().enumerate() {
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

/// The lamp itself, a soft disc on the ceiling.
fn lamp_glow(scene: &Scene, hit: &Hit) -> Vector {
    if hit.object.is_some() || hit.normal.0[1] < 0.5 {
        return Vector::ZERO;
    }
    let across = hit.point - scene.lamp;
    let squared = across.0[0].powi(2) + across.0[2].powi(2);
    Vector([1.0, 0.95, 0.85]) * (2.0 * smooth(1.5 - 12.0 * squared))
}

/// Hermite step from 0 to 1.
fn smooth(x: f32) -> f32 {
    let x = x.clamp(0.0, 1.0);
    x * x * (3.0 - 2.0 * x)
}

#[cfg(test)]
mod tests {
    use super::super::SyntheticConfig;
    use super::super::texture::Texture;
    use super::*;
    use crate::order::step_rng;

    const RED: Vector = Vector([1.0, 0.0, 0.0]);

    /// A room of one colour with one ball in it, and the default camera path.
    fn scene(room: Vector, ball: Vector, gloss: f32) -> Scene {
        let config = SyntheticConfig { num_objects: [0, 0], ..Default::default() };
        let mut scene = Scene::draw(&mut step_rng(5, 0, "test"), &config);
        scene.walls = [(); 6].map(|()| Texture::plain(room));
        let shape = Shape::Ball { radius: 0.2 };
        let center = Vector([0.1, 0.2, -0.1]);
        scene.objects.push(Object { shape, center, texture: Texture::plain(ball), gloss });
        scene
    }

    #[test]
    fn a_ball_appears_where_the_camera_projects_its_centre() {
        let scene = scene(Vector::ZERO, RED, 0.0);
        for time in [0.0, 0.2, 0.4, 0.6, 0.8, 1.0] {
            let camera = scene.path.camera(time, 75.0, 1.5);
            let frame = render(&scene, &camera, 192, 128, 1, 0.0);
            let (mut sum, mut count) = ([0.0; 2], 0.0);
            for (index, pixel) in frame.rgb.chunks_exact(3).enumerate() {
                if pixel[0] > 30 && pixel[2] == 0 {
                    sum[0] += (index % 192) as f64 + 0.5;
                    sum[1] += (index / 192) as f64 + 0.5;
                    count += 1.0;
                }
            }
            let [x, y, depth] = camera.c2w.inverse().apply(scene.objects[0].center.0.map(f64::from));
            let pixels = camera.intrinsics_norm.to_pixels(192, 128);
            let center = [pixels.fx * x / depth + pixels.cx, pixels.fy * y / depth + pixels.cy];
            // A ball off the axis looks like an ellipse whose middle lies outwards of the projected centre, by
            // less than (radius / depth)^2 of the distance from the axis.
            for (axis, middle) in [pixels.cx, pixels.cy].into_iter().enumerate() {
                let off_axis = (center[axis] - middle).abs();
                let tolerance = 0.3 + off_axis * (0.2 / depth).powi(2);
                let got = sum[axis] / count;
                assert!((got - center[axis]).abs() < tolerance, "axis {axis} at {time}: {got}, not {}", center[axis]);
            }
            let radius = pixels.fx * 0.2 / depth;
            let area = std::f64::consts::PI * radius * radius;
            assert!((0.95..1.35).contains(&(count / area)), "{count} pixels for a disc of {area}");
        }
    }

    #[test]
    fn the_floor_below_a_ball_is_in_shadow() {
        let mut scene = scene(Vector::ONE, RED, 0.0);
        let floor = scene.half_size.0[1];
        scene.lamp = Vector([0.1, -floor + 0.1, -0.1]);
        let light =
            |scene: &Scene, x: f32| trace(scene, Vector([x, floor - 0.05, -0.1]), Vector([0.0, 1.0, 0.0]), 0.0, true);
        let (below, beside) = (light(&scene, 0.1), light(&scene, 0.9));
        assert!(below.0[1] < 0.5 * beside.0[1], "{below:?} {beside:?}");
        scene.objects.clear();
        let (below, beside) = (light(&scene, 0.1), light(&scene, 0.9));
        assert!(below.0[1] > beside.0[1], "without the ball it is brightest below the lamp");
    }

    #[test]
    fn only_specular_surfaces_change_with_the_view() {
        let scene = scene(Vector([0.2, 0.4, 0.8]), RED, 1.0);
        let ball = &scene.objects[0];
        let top = ball.center + Vector([0.0, -0.2, 0.0]);
        let seen_from = |origin: Vector, specular: f32| trace(&scene, origin, (top - origin).unit(), specular, true);
        let (left, right) = (Vector([-1.0, -0.6, 0.3]), Vector([0.9, -0.3, 0.2]));
        let difference = |specular: f32| (seen_from(left, specular) - seen_from(right, specular)).length();
        assert!(difference(0.0) < 1e-4, "{}", difference(0.0));
        assert!(difference(1.0) > 0.02, "{}", difference(1.0));
    }

    #[test]
    fn a_turned_block_is_met_at_its_faces() {
        let turn = [0.6, 0.8];
        let half_size = Vector([0.3, 0.2, 0.1]);
        let shape = Shape::Block { half_size, turn };
        let object = Object { shape, center: Vector([1.0, 0.0, 2.0]), texture: Texture::plain(RED), gloss: 0.0 };
        for axis in 0..3 {
            let mut local = Vector::ZERO;
            local.0[axis] = 1.0;
            let outwards = local.turned([turn[0], -turn[1]]);
            let (distance, normal) = meet(&object, object.center + outwards * 5.0, -outwards).unwrap();
            assert!((distance - (5.0 - half_size.0[axis])).abs() < 1e-5, "axis {axis}: {distance}");
            assert!((normal - outwards).length() < 1e-5, "axis {axis}: {normal:?}");
        }
        assert!(meet(&object, Vector([0.0, 0.5, 0.0]), Vector([0.0, 0.0, 1.0])).is_none());
        let behind = meet(&object, Vector([1.0, 0.0, 4.0]), Vector([0.0, 0.0, 1.0]));
        assert!(behind.is_none(), "what is behind the origin is not met");
    }
}
