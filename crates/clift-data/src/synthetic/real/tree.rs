//! A tree of boxes around the solids: rays test only the solids near them.

use glam::{Vec3, Vec4};

use crate::synthetic::real::solid::{Rays, Solid};

/// Largest number of solids in a leaf.
const LEAF: usize = 2;
/// Entries of the stack of a walk: the tree is balanced, and no scene has 2^30 solids.
const DEPTH: usize = 32;

#[derive(Clone, Debug, PartialEq)]
struct Node {
    low: Vec3,
    high: Vec3,
    /// Of a leaf, the position of its first solid; otherwise that of the second child. The first child follows its parent.
    next: usize,
    /// Number of solids; 0 for an inner node.
    count: usize,
    /// Axis along which the children are ordered.
    axis: usize,
}

/// A balanced tree. Reorders the solids, so that those of a leaf are neighbours.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Tree {
    nodes: Vec<Node>,
}

impl Tree {
    pub fn new(solids: &mut [Solid]) -> Self {
        let mut tree = Self { nodes: Vec::with_capacity(solids.len().max(1) * 2) };
        tree.add(solids, 0);
        tree
    }

    fn add(&mut self, solids: &mut [Solid], first: usize) {
        let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        for solid in &*solids {
            let [from, to] = solid.bounds();
            (low, high) = (low.min(from), high.max(to));
        }
        let here = self.nodes.len();
        if solids.len() <= LEAF {
            self.nodes.push(Node { low, high, next: first, count: solids.len(), axis: 0 });
            return;
        }
        let axis = (high - low).max_position();
        solids.sort_by(|a, b| a.center[axis].total_cmp(&b.center[axis]));
        self.nodes.push(Node { low, high, next: 0, count: 0, axis });
        let (one, other) = solids.split_at_mut(solids.len() / 2);
        self.add(one, first);
        self.nodes[here].next = self.nodes.len();
        self.add(other, first + one.len());
    }

    /// Calls `visit` with the position of every solid whose box a ray meets before its end. `visit` returns the new ends.
    pub fn walk(&self, rays: &Rays, mut ends: Vec4, mut visit: impl FnMut(usize, Vec4) -> Vec4) {
        let inverse = rays.direction.map(|slope| {
            let least = Vec4::splat(1e-12);
            Vec4::select(slope.abs().cmplt(least), least, slope).recip()
        });
        let forward = rays.direction.map(|slope| slope.x > 0.0);
        let mut stack = [0; DEPTH];
        let mut waiting = 1;
        while waiting > 0 {
            waiting -= 1;
            let here = stack[waiting];
            let node = &self.nodes[here];
            let (mut near, mut far) = (Vec4::ZERO, ends);
            for axis in 0..3 {
                let one = (Vec4::splat(node.low[axis]) - rays.origin[axis]) * inverse[axis];
                let other = (Vec4::splat(node.high[axis]) - rays.origin[axis]) * inverse[axis];
                near = near.max(one.min(other));
                far = far.min(one.max(other));
            }
            if !near.cmple(far).any() {
                continue;
            }
            if node.count > 0 || node.next == 0 {
                for solid in node.next..node.next + node.count {
                    ends = visit(solid, ends);
                }
                continue;
            }
            // The nearer child is taken first: what it hides is never visited.
            let (nearer, farther) = if forward[node.axis] { (here + 1, node.next) } else { (node.next, here + 1) };
            stack[waiting] = farther;
            stack[waiting + 1] = nearer;
            waiting += 2;
        }
    }
}
