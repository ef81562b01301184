//! All surfaces of a scene: solids above an endless ground.

use glam::{Vec3, Vec4};

use crate::synthetic::tracing::solid::{Rays, Solid};
use crate::synthetic::tracing::surface::Surface;
use crate::synthetic::tracing::tree::Tree;

pub(crate) const GROUND: usize = usize::MAX - 1;
pub(crate) const SKY: usize = usize::MAX;

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct World {
    pub solids: Vec<Solid>,
    pub surfaces: Vec<Surface>,
    /// Height of the ground, downwards, and its surface.
    pub ground: (f32, usize),
    pub tree: Tree,
}

impl World {
    pub fn new(mut solids: Vec<Solid>, surfaces: Vec<Surface>, ground: (f32, usize)) -> Self {
        let tree = Tree::new(&mut solids);
        Self { solids, surfaces, ground, tree }
    }

    /// Returns the distances at which four rays end, and the number of the solid there.
    pub fn nearest(&self, rays: &Rays) -> (Vec4, [usize; 4]) {
        let mut ends = self.to_ground(rays);
        let best = ends.0;
        self.tree.walk(rays, best, |number, _| {
            self.meet(rays, number, &mut ends);
            ends.0
        });
        ends
    }

    /// As [`World::nearest`] for rays in the pyramid of a list of [`Tree::ahead`]. Its directions are at least 1 long: its
    /// distances are lower bounds.
    pub fn nearest_of(&self, rays: &Rays, ahead: &[(f32, usize)]) -> (Vec4, [usize; 4]) {
        let mut ends = self.to_ground(rays);
        let mut last = ends.0.max_element();
        for &(near, number) in ahead {
            if near > last {
                break;
            }
            if self.meet(rays, number, &mut ends) {
                last = ends.0.max_element();
            }
        }
        ends
    }

    fn to_ground(&self, rays: &Rays) -> (Vec4, [usize; 4]) {
        let down = (Vec4::splat(self.ground.0) - rays.origin[1]) / rays.direction[1];
        let hit = down.cmpgt(Vec4::ZERO) & down.cmplt(Vec4::splat(1e6));
        let mask = hit.bitmask();
        let numbers = [0, 1, 2, 3].map(|lane| if mask >> lane & 1 == 1 { GROUND } else { SKY });
        (Vec4::select(hit, down, Vec4::INFINITY), numbers)
    }

    /// Moves the ends of the rays that meet a solid before; returns whether any does.
    fn meet(&self, rays: &Rays, number: usize, (ends, numbers): &mut (Vec4, [usize; 4])) -> bool {
        let spans = self.solids[number].spans(rays);
        let hit = spans.is_hit() & spans.near.cmpgt(Vec4::ZERO) & spans.near.cmplt(*ends);
        let mask = hit.bitmask();
        if mask == 0 {
            return false;
        }
        for (lane, found) in numbers.iter_mut().enumerate() {
            if mask >> lane & 1 == 1 {
                *found = number;
            }
        }
        *ends = Vec4::select(hit, spans.near, *ends);
        true
    }

    pub fn first(&self, origin: Vec3, direction: Vec3) -> (f32, usize) {
        let (distances, numbers) = self.nearest(&Rays::new([origin; 4], [direction; 4]));
        (distances.x, numbers[0])
    }

    /// Returns the share of a lamp of the angular size `softness` that is seen along four rays to it of the lengths `ends`.
    /// The penumbra is estimated from the length of a ray inside a solid; no rays are sampled.
    pub fn lamp_share(&self, rays: &Rays, ends: Vec4, softness: f32) -> Vec4 {
        let mut share = Vec4::ONE;
        self.tree.walk(rays, ends, |number, ends| {
            let spans = self.solids[number].spans(rays);
            let hit = spans.is_hit() & spans.near.cmpgt(Vec4::ZERO) & spans.near.cmplt(ends);
            if !hit.any() {
                return ends;
            }
            let open = Vec4::ONE - (spans.far - spans.near) / (spans.near * softness + 1e-3);
            share = Vec4::select(hit, share.min(open.max(Vec4::ZERO)), share);
            Vec4::select(share.cmpgt(Vec4::ZERO), ends, Vec4::NEG_ONE)
        });
        share
    }

    /// Returns how far four rays get, as a share of `reach`.
    pub fn free_share(&self, rays: &Rays, reach: f32) -> Vec4 {
        let mut free = Vec4::splat(reach);
        self.tree.walk(rays, free, |number, _| {
            let spans = self.solids[number].spans(rays);
            let hit = spans.is_hit() & spans.near.cmpgt(Vec4::ZERO);
            free = Vec4::select(hit, free.min(spans.near), free);
            free
        });
        free / reach
    }

    pub fn normal(&self, number: usize, point: Vec3) -> Vec3 {
        if number == GROUND { Vec3::NEG_Y } else { self.solids[number].normal(point) }
    }

    /// Returns the surface with this number and the colour at a point of it, averaged over `width`.
    pub fn color(&self, number: usize, point: Vec3, normal: Vec3, width: f32) -> (&Surface, Vec3) {
        let (surface, [u, v]) = if number == GROUND {
            (&self.surfaces[self.ground.1], [point.x, point.z])
        } else {
            let solid = &self.solids[number];
            (&self.surfaces[solid.surface], solid.coordinates(point, normal))
        };
        (surface, surface.color(u, v, width))
    }

    pub fn clear_away(self, points: &[Vec3], clearance: f32) -> Self {
        let Self { mut solids, surfaces, ground, .. } = self;
        solids.retain(|solid| points.iter().all(|&point| solid.distance(point) > clearance));
        Self::new(solids, surfaces, ground)
    }

    pub fn is_clear(&self, point: Vec3, clearance: f32) -> bool {
        point.y + clearance < self.ground.0 && self.solids.iter().all(|solid| solid.distance(point) > clearance)
    }
}
