//! A tree of boxes around the solids: rays test only the solids near them.

use glam::{Vec3, Vec4};

use crate::synthetic::tracing::solid::{Rays, Solid};

const LEAF: usize = 3;
/// Entries of the stack of a walk. A part is split at least 1 to [`BALANCE`], which keeps the depth below it.
const DEPTH: usize = 64;
/// Largest share of the solids of a node, in parts of 8, that one child may hold.
const BALANCE: usize = 7;
/// Places between which a node may be divided, per axis.
const BINS: usize = 8;

#[derive(Clone, Debug, PartialEq)]
struct Node {
    low: Vec3,
    high: Vec3,
    /// Of a leaf, the position of its first solid; otherwise that of the second child. The first child follows its parent.
    next: u32,
    /// Number of solids; 0 for an inner node.
    count: u16,
    axis: u16,
}

/// A tree in which a division of a node minimises the expected work of a ray (surface areas times numbers of solids).
/// Reorders the solids, so that those of a leaf are neighbours.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Tree {
    nodes: Vec<Node>,
}

#[derive(Clone, Copy)]
struct Bounds {
    low: Vec3,
    high: Vec3,
}

impl Bounds {
    const NONE: Self = Self { low: Vec3::INFINITY, high: Vec3::NEG_INFINITY };

    fn and(self, [low, high]: [Vec3; 2]) -> Self {
        Self { low: self.low.min(low), high: self.high.max(high) }
    }

    fn area(self) -> f32 {
        let size = (self.high - self.low).max(Vec3::ZERO);
        size.x * size.y + size.y * size.z + size.z * size.x
    }
}

impl Tree {
    pub fn new(solids: &mut Vec<Solid>) -> Self {
        let mut order: Vec<([Vec3; 2], u32)> =
            solids.iter().zip(0..).map(|(solid, number)| (solid.bounds(), number)).collect();
        let mut tree = Self { nodes: Vec::with_capacity(order.len().max(1) * 2) };
        tree.add(&mut order, 0);
        *solids = order.iter().map(|&(_, number)| solids[number as usize].clone()).collect();
        tree
    }

    fn add(&mut self, order: &mut [([Vec3; 2], u32)], first: u32) {
        let Bounds { low, high } = order.iter().fold(Bounds::NONE, |all, (bounds, _)| all.and(*bounds));
        let here = self.nodes.len();
        if order.len() <= LEAF {
            self.nodes.push(Node { low, high, next: first, count: order.len() as u16, axis: 0 });
            return;
        }
        let (axis, left) = divide(order);
        self.nodes.push(Node { low, high, next: 0, count: 0, axis: axis as u16 });
        let (one, other) = order.split_at_mut(left);
        self.add(one, first);
        self.nodes[here].next = self.nodes.len() as u32;
        self.add(other, first + left as u32);
    }

    /// Lists the solids whose boxes a pyramid of rays may meet, nearest first, with the distances to the boxes. The rays
    /// start at `origin`; their directions, not of length 1, lie between `low` and `high`, and distances are in these units.
    pub fn ahead(&self, solids: &[Solid], origin: Vec3, [low, high]: [Vec3; 2], found: &mut Vec<(f32, usize)>) {
        found.clear();
        let may_meet = |[from, to]: [Vec3; 2]| {
            let (mut near, mut far) = (0.0_f32, f32::INFINITY);
            for axis in 0..3 {
                let (from, to) = (from[axis] - origin[axis], to[axis] - origin[axis]);
                let (slow, fast) = (low[axis], high[axis]);
                // Along this axis, the rays are between `slow * t` and `fast * t` at the distance `t`.
                let limits = [(to, slow), (-from, -fast)];
                for (bound, slope) in limits {
                    if slope > 0.0 {
                        far = far.min(bound / slope);
                    } else if bound < 0.0 {
                        near = near.max(if slope < 0.0 { bound / slope } else { f32::INFINITY });
                    }
                }
            }
            (near <= far).then_some(near)
        };
        let mut stack = [0_u32; DEPTH];
        let mut waiting = 1;
        while waiting > 0 {
            waiting -= 1;
            let here = stack[waiting];
            let node = &self.nodes[here as usize];
            if may_meet([node.low, node.high]).is_none() {
                continue;
            }
            if node.count > 0 || node.next == 0 {
                let all = node.next as usize..node.next as usize + usize::from(node.count);
                found.extend(all.filter_map(|number| Some((may_meet(solids[number].bounds())?, number))));
            } else {
                (stack[waiting], stack[waiting + 1]) = (node.next, here + 1);
                waiting += 2;
            }
        }
        found.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    }

    /// Calls `visit` with the position of every solid whose box a ray meets before its end. `visit` returns the new ends;
    /// a negative end ends a ray.
    pub fn walk(&self, rays: &Rays, mut ends: Vec4, mut visit: impl FnMut(usize, Vec4) -> Vec4) {
        let inverse = rays.direction.map(|slope| {
            let least = Vec4::splat(1e-12);
            Vec4::select(slope.abs().cmplt(least), least, slope).recip()
        });
        let [x, y, z] = inverse;
        let [from_x, from_y, from_z] = [0, 1, 2].map(|axis| rays.origin[axis] * inverse[axis]);
        let forward = rays.direction.map(|slope| slope.x > 0.0);
        let mut stack = [0_u32; DEPTH];
        let mut waiting = 1;
        while waiting > 0 {
            waiting -= 1;
            let here = stack[waiting];
            let node = &self.nodes[here as usize];
            let slab = |low: f32, high: f32, inverse: Vec4, from: Vec4| {
                let (one, other) = (inverse * low - from, inverse * high - from);
                (one.min(other), one.max(other))
            };
            let (near_x, far_x) = slab(node.low.x, node.high.x, x, from_x);
            let (near_y, far_y) = slab(node.low.y, node.high.y, y, from_y);
            let (near_z, far_z) = slab(node.low.z, node.high.z, z, from_z);
            let near = near_x.max(near_y).max(near_z).max(Vec4::ZERO);
            let far = far_x.min(far_y).min(far_z).min(ends);
            if !near.cmple(far).any() {
                continue;
            }
            if node.count > 0 || node.next == 0 {
                for solid in node.next..node.next + u32::from(node.count) {
                    ends = visit(solid as usize, ends);
                }
                continue;
            }
            // The nearer child is taken first: what it hides is never visited.
            let is_forward = forward[usize::from(node.axis)];
            let (nearer, farther) = if is_forward { (here + 1, node.next) } else { (node.next, here + 1) };
            stack[waiting] = farther;
            stack[waiting + 1] = nearer;
            waiting += 2;
        }
    }
}

/// Divides solids into two groups along an axis: orders them and returns the axis and the size of the first group.
fn divide(order: &mut [([Vec3; 2], u32)]) -> (usize, usize) {
    let middle = |&([low, high], _): &([Vec3; 2], u32)| low + high;
    let (low, high) = order
        .iter()
        .map(middle)
        .fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), point| (low.min(point), high.max(point)));
    let per_bin = BINS as f32 / (high - low).max(Vec3::splat(1e-6));
    let bin = |item: &([Vec3; 2], u32), axis: usize| {
        (((middle(item)[axis] - low[axis]) * per_bin[axis]) as usize).min(BINS - 1)
    };
    let most = order.len() * BALANCE / 8;
    let mut best = (f32::INFINITY, 0, 0);
    for axis in 0..3 {
        let mut bins = [(Bounds::NONE, 0_usize); BINS];
        for item in &*order {
            let (bounds, count) = &mut bins[bin(item, axis)];
            (*bounds, *count) = (bounds.and(item.0), *count + 1);
        }
        let mut costs = [(0.0, 0); BINS];
        for from_left in [true, false] {
            let (mut all, mut count) = (Bounds::NONE, 0);
            for step in 0..BINS - 1 {
                let place = if from_left { step } else { BINS - 1 - step };
                all = all.and([bins[place].0.low, bins[place].0.high]);
                count += bins[place].1;
                // The cost of the division after bin `step`.
                let cost = &mut costs[if from_left { step } else { place - 1 }];
                cost.0 += if count == 0 { 0.0 } else { all.area() * count as f32 };
                if from_left {
                    cost.1 = count;
                }
            }
        }
        for (place, &(cost, left)) in costs[..BINS - 1].iter().enumerate() {
            if cost < best.0 && left.max(order.len() - left) <= most {
                best = (cost, axis, place + 1);
            }
        }
    }
    let (cost, axis, place) = best;
    if cost.is_finite() {
        // Stable, and two groups only: the order within a group does not matter.
        order.sort_by_key(|item| bin(item, axis) >= place);
        return (axis, order.iter().filter(|item| bin(item, axis) < place).count());
    }
    let axis = (high - low).max_position();
    order.sort_by(|a, b| middle(a)[axis].total_cmp(&middle(b)[axis]));
    (axis, order.len() / 2)
}
