//! Camera paths: clips through a place, arcs around a thing, turns on the spot.

use std::f32::consts::TAU;

use clift_core::{Camera, IntrinsicsNorm, Pose};
use glam::{DMat3, Vec3, Vec4};

use crate::synthetic::real::dice::Dice;
use crate::synthetic::tracing::noise::{byte, hash};
use crate::synthetic::tracing::solid::Rays;
use crate::synthetic::tracing::world::{GROUND, SKY, World};

/// Attempts to find a path on which the camera sees enough; afterwards the best one found counts.
const ATTEMPTS: usize = 24;
const GOOD: f32 = 0.85;
/// Number of rays along each side of the views that check a path.
const GLANCE: usize = 6;
/// Largest distance of the principal point from the image center, in image sizes: two pixels of 64. Patches of four pixels
/// then begin at any pixel, as those of shifted patch grids do.
const OFF_CENTER: f32 = 1.0 / 32.0;

pub(crate) struct Area {
    /// Middle and half sizes of the box in which a path starts (y is down).
    pub center: Vec3,
    pub half: Vec3,
    /// Middle and radius of the thing that arcs turn around.
    pub thing: Option<(Vec3, f32)>,
    pub clearance: f32,
}

/// A smooth path; `time` runs from 0 to 1. Positions and fixated points follow a parabola with small swings.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Path {
    fov_deg: f32,
    route: Route,
    /// Amplitude, cycles and phase of the swings of the position along three axes.
    swing: [[f32; 3]; 3],
    /// The same for yaw, pitch and roll, in radians.
    shake: [[f32; 3]; 3],
    /// Amplitude of independent turns of every frame, in radians.
    jitter: f32,
    spread: Spread,
    seed: u32,
}

/// Largest differences between the photos of one path, either way.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Spread {
    /// Roll in radians.
    roll: f32,
    /// Natural logarithm of the focal length.
    zoom: f32,
    /// Exposure in stops.
    stops: f32,
}

#[derive(Clone, Debug, PartialEq)]
enum Route {
    /// Position, velocity and acceleration; yaw and pitch at the start, the turn of the yaw and of the pitch over the path.
    Move { at: [Vec3; 3], look: [f32; 2], turn: [f32; 2] },
    /// Around `center`: start angle, sweep, distance at the start and its change, height and its change.
    Arc { center: Vec3, angle: [f32; 2], distance: [f32; 2], height: [f32; 2] },
}

impl Path {
    /// Samples a path in `area`. Prefers paths that stay clear of all surfaces and see mostly things further away.
    pub fn sample(dice: &mut Dice, world: &World, area: &Area) -> Self {
        let mut best = (f32::NEG_INFINITY, None);
        for _ in 0..ATTEMPTS {
            let path = Self::propose(dice, world, area);
            let score = path.score(world, area.clearance);
            if score > best.0 {
                best = (score, Some(path));
            }
            if score >= GOOD {
                break;
            }
        }
        best.1.expect("every score is above negative infinity")
    }

    fn propose(dice: &mut Dice, world: &World, area: &Area) -> Self {
        let fov_deg = if dice.chance(0.7) { dice.between(42.0, 72.0) } else { dice.between(40.0, 100.0) };
        let is_arc = area.thing.is_some() && dice.chance(0.8);
        let route = match area.thing {
            Some((center, radius)) if is_arc => {
                let side = dice.pick(&[-1.0, 1.0]);
                let sweep = dice.scale(0.3, 2.0);
                let distance = radius + radius * dice.scale(0.5, 3.0);
                let angle = [dice.between(0.0, TAU), side * sweep];
                let height = [distance * dice.between(-0.1, 0.7), distance * dice.swing(0.2)];
                Route::Arc { center, angle, distance: [distance, distance * dice.swing(0.25)], height }
            }
            _ => Self::propose_move(dice, world, area, fov_deg),
        };
        // By hand or on rails.
        let by_hand = if is_arc { dice.between(0.3, 1.0) } else { dice.between(0.0, 0.25) };
        let size = match &route {
            Route::Move { at, .. } => 0.05 * at[1].length(),
            Route::Arc { distance, .. } => 0.03 * distance[0],
        };
        let mut wave = |size: f32| [dice.between(0.2, 1.0) * size, dice.between(0.5, 3.0), dice.between(0.0, TAU)];
        let swing = [(); 3].map(|()| wave(size));
        let shake = [0.08, 0.07, 0.09].map(|size| wave(size * by_hand));
        Self { fov_deg, route, swing, shake, jitter: 0.02 * by_hand, spread: Spread::default(), seed: dice.bits() }
    }

    /// Makes the frames photos of several people: cameras turned, zoomed and exposed differently, arcs up to half a circle.
    pub fn spread_out(&mut self) {
        let [some, more] = [0, 1].map(|row| hash(-1, row, self.seed));
        // Most paths have little of each, few have all.
        let share = |part| byte(some, part).powi(3);
        self.spread = Spread { roll: 0.5 * share(0), zoom: 0.25 * share(1), stops: 0.8 * share(2) };
        if let Route::Arc { angle, .. } = &mut self.route {
            angle[1] *= 1.0 + 0.6 * byte(more, 0);
        }
    }

    fn propose_move(dice: &mut Dice, world: &World, area: &Area, fov_deg: f32) -> Route {
        let half = area.half;
        let start = area.center + Vec3::new(dice.swing(half.x), dice.swing(half.y), dice.swing(half.z));
        let yaw = dice.between(0.0, TAU);
        let pitch = dice.swing(0.12) + 0.05;
        let forward = Vec3::new(yaw.sin(), 0.0, yaw.cos());
        let right = Vec3::new(forward.z, 0.0, -forward.x);
        let (depth, _) = world.first(start, forward);
        let depth = depth.clamp(1.0, 12.0);
        let still = dice.chance(0.15);
        let length = depth * if still { dice.between(0.0, 0.05) } else { dice.scale(0.12, 0.8) };
        // Forwards, sideways, backwards.
        let way = match dice.count(0, 9) {
            0..=4 => dice.swing(0.5),
            5..=8 => dice.pick(&[-1.0, 1.0]) * dice.between(0.8, 1.9),
            _ => 0.5 * TAU + dice.swing(0.4),
        };
        let velocity = (forward * way.cos() + right * way.sin()) * length + Vec3::Y * (0.06 * length * dice.swing(1.0));
        let bend = (right * way.cos() - forward * way.sin()) * (length * dice.swing(0.35));
        // A pan keeps most of the first view in sight.
        let pan = fov_deg.to_radians() * if still { dice.between(0.3, 0.9) } else { dice.between(0.0, 0.6) };
        let turn = [dice.pick(&[-1.0, 1.0]) * pan, dice.swing(0.1)];
        Route::Move { at: [start, velocity, bend], look: [yaw, pitch], turn }
    }

    pub fn positions(&self) -> Vec<Vec3> {
        (0..=64).map(|step| self.position(step as f32 / 64.0)).collect()
    }

    /// Returns 1 or more for a good path: clear of surfaces, many things in sight, few of them very near.
    fn score(&self, world: &World, clearance: f32) -> f32 {
        let times = [0, 4, 8, 2, 6, 1, 3, 5, 7].map(|check| check as f32 / 8.0);
        let clear = times.iter().take_while(|&&time| world.is_clear(self.position(time), clearance)).count();
        if clear < times.len() {
            return clear as f32 / times.len() as f32 - 2.0;
        }
        let (mut near, mut empty, mut rays) = (0.0, 0.0, 0.0);
        let mut seen = Vec::new();
        for time in [0.0, 0.5, 1.0] {
            for (.., distance, number) in self.glance::<GLANCE>(world, time) {
                near += smaller(distance, 5.0 * clearance);
                empty += f32::from(number == SKY || number == GROUND || distance > 40.0);
                rays += 1.0;
                if !seen.contains(&number) {
                    seen.push(number);
                }
            }
        }
        let variety = (seen.len() as f32 / 16.0 - 1.0).min(0.0);
        1.0 + (0.15 - near / rays).min(0.0) + (0.5 - empty / rays).min(0.0) + variety
    }

    /// Returns origin, direction, distance and number of the solid of `SIDE` x `SIDE` rays, rounded up to a multiple of 4,
    /// of a square view.
    pub fn glance<const SIDE: usize>(
        &self,
        world: &World,
        time: f32,
    ) -> impl Iterator<Item = (Vec3, Vec3, f32, usize)> {
        let camera = self.camera(time, 1.0, 0);
        let origin = camera.c2w.translation.as_vec3();
        let rotation = camera.c2w.rotation.as_mat3();
        let scale = 1.0 / (camera.intrinsics.fx as f32 * SIDE as f32);
        (0..SIDE * SIDE).step_by(4).flat_map(move |first| {
            let at = |step: usize| (step as f32 + 0.5 - 0.5 * SIDE as f32) * scale;
            let lanes = [0, 1, 2, 3].map(|lane| first + lane);
            let (x, y) = (lanes.map(|lane| at(lane % SIDE)), lanes.map(|lane| at(lane / SIDE)));
            let rays = Rays::through(origin, &rotation, Vec4::from_array(x), Vec4::from_array(y));
            let ((distances, numbers), directions) = (world.nearest(&rays), rays.directions());
            [0, 1, 2, 3].map(|lane| (origin, directions[lane], distances[lane], numbers[lane]))
        })
    }

    fn position(&self, time: f32) -> Vec3 {
        let swing = self.swing.map(|wave| sway(wave, time));
        let middle = match &self.route {
            Route::Move { at: [start, velocity, bend], .. } => *start + *velocity * time + *bend * (time * time),
            Route::Arc { center, angle, distance, height } => {
                let (sin, cos) = (angle[0] + angle[1] * time).sin_cos();
                let distance = distance[0] + distance[1] * time;
                *center + Vec3::new(sin * distance, -height[0] - height[1] * time, cos * distance)
            }
        };
        middle + Vec3::from(swing)
    }

    /// Returns the camera of one frame, with square pixels, a principal point of its own, and the path's field of view along
    /// the longer side.
    pub fn camera(&self, time: f32, aspect: f64, frame: usize) -> Camera<IntrinsicsNorm> {
        let position = self.position(time);
        let [mut yaw, mut pitch, roll] = self.shake.map(|wave| sway(wave, time));
        match &self.route {
            Route::Move { look, turn, .. } => {
                yaw += look[0] + turn[0] * time;
                pitch += look[1] + turn[1] * time;
            }
            Route::Arc { center, .. } => {
                let way = *center - position;
                yaw += way.x.atan2(way.z);
                pitch += way.y.atan2(way.x.hypot(way.z));
            }
        }
        let Spread { roll: turned, zoom, .. } = self.spread;
        let [turned, zoom] = [(turned, 0), (zoom, 1)].map(|(most, part)| most * self.difference(frame, part));
        let roll = roll + turned;
        let noise = hash(frame as i32, 0, self.seed);
        let [yaw, pitch, roll] = [(yaw, 0), (pitch, 1), (roll, 2)]
            .map(|(angle, part)| f64::from(angle + self.jitter * (2.0 * byte(noise, part) - 1.0)));
        let rotation = DMat3::from_rotation_y(yaw) * DMat3::from_rotation_x(-pitch) * DMat3::from_rotation_z(roll);
        let longer = 0.5 / (0.5 * f64::from(self.fov_deg).to_radians()).tan();
        let fx = longer / aspect.min(1.0) * f64::from(zoom.exp());
        let shift = hash(frame as i32, 1, self.seed);
        let [cx, cy] = [0, 1].map(|part| f64::from(0.5 + OFF_CENTER * (2.0 * byte(shift, part) - 1.0)));
        Camera {
            intrinsics: IntrinsicsNorm { fx, fy: fx * aspect, cx, cy },
            c2w: Pose { rotation, translation: position.as_dvec3() },
        }
    }

    pub fn exposure(&self, frame: usize) -> f32 {
        (self.spread.stops * self.difference(frame, 2)).exp2()
    }

    /// Returns a value of a frame's own in `[-1, 1]`.
    fn difference(&self, frame: usize, part: u32) -> f32 {
        2.0 * byte(hash(frame as i32, 2, self.seed), part) - 1.0
    }
}

fn sway([size, cycles, phase]: [f32; 3], time: f32) -> f32 {
    size * (TAU * cycles * time + phase).sin()
}

/// Returns 1 for a distance of 0, and 0 from `limit` on.
fn smaller(distance: f32, limit: f32) -> f32 {
    (1.0 - distance / limit).max(0.0)
}
