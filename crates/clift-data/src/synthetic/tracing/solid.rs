//! Convex solids and their intersection with four rays at once.

use glam::{BVec4A, Mat3, Vec3, Vec4};

/// Smallest absolute slope of a slab test; keeps the test finite for rays along a face.
const LEAST_SLOPE: f32 = 1e-7;

/// Shape within the cube `[-1, 1]^3` of a solid's own coordinates (y is down).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Shape {
    Block,
    Ball,
    Column,
    /// Triangle with the base at y = 1 and the ridge along z at y = -1.
    Roof,
}

/// Four rays: one component of all rays per [`Vec4`]. Directions have length 1.
#[derive(Clone, Copy)]
pub(crate) struct Rays {
    pub origin: [Vec4; 3],
    pub direction: [Vec4; 3],
}

impl Rays {
    /// Returns rays from one origin through the points `(x, y, 1)` of the axes of a camera.
    pub fn through(origin: Vec3, axes: &Mat3, x: Vec4, y: Vec4) -> Self {
        let along = |axis: usize| x * axes.x_axis[axis] + y * axes.y_axis[axis] + axes.z_axis[axis];
        let [a, b, c] = [along(0), along(1), along(2)];
        let scale = (a * a + b * b + c * c).map(f32::sqrt).recip();
        Self { origin: origin.to_array().map(Vec4::splat), direction: [a * scale, b * scale, c * scale] }
    }

    pub fn directions(&self) -> [Vec3; 4] {
        let [a, b, c] = self.direction.map(|lanes| lanes.to_array());
        [0, 1, 2, 3].map(|lane| Vec3::new(a[lane], b[lane], c[lane]))
    }

    pub fn new(origins: [Vec3; 4], directions: [Vec3; 4]) -> Self {
        let lanes = |v: [Vec3; 4]| [0, 1, 2].map(|axis| Vec4::from_array(v.map(|v| v[axis])));
        Self { origin: lanes(origins), direction: lanes(directions) }
    }
}

/// Distances at which four lines enter and leave a solid; a line misses it if `near > far`.
#[derive(Clone, Copy)]
pub(crate) struct Spans {
    pub near: Vec4,
    pub far: Vec4,
}

impl Spans {
    const ALL: Self = Self { near: Vec4::NEG_INFINITY, far: Vec4::INFINITY };

    /// Keeps the part where `|origin + t * direction| <= 1`.
    fn within_slab(self, origin: Vec4, direction: Vec4) -> Self {
        let steep = Vec4::splat(LEAST_SLOPE);
        let direction = Vec4::select(direction.abs().cmplt(steep), steep, direction);
        let inverse = direction.recip();
        let (middle, reach) = (-origin * inverse, inverse.abs());
        Self { near: self.near.max(middle - reach), far: self.far.min(middle + reach) }
    }

    /// Keeps the part where `origin + t * slope <= 0`.
    fn below(self, origin: Vec4, slope: Vec4) -> Self {
        let steep = Vec4::splat(LEAST_SLOPE);
        let slope = Vec4::select(slope.abs().cmplt(steep), steep, slope);
        let at = -origin / slope;
        let leaves = slope.cmpgt(Vec4::ZERO);
        Self {
            near: Vec4::select(leaves, self.near, self.near.max(at)),
            far: Vec4::select(leaves, self.far.min(at), self.far),
        }
    }

    /// Keeps the part where `a t^2 + 2 b t + c <= 0`, with `a > 0`.
    fn within_quadric(self, a: Vec4, b: Vec4, c: Vec4) -> Self {
        let a = a.max(Vec4::splat(LEAST_SLOPE * LEAST_SLOPE));
        let inside = b * b - a * c;
        let root = inside.max(Vec4::ZERO).map(f32::sqrt);
        let missed = inside.cmplt(Vec4::ZERO);
        let inverse = a.recip();
        Self {
            near: Vec4::select(missed, Vec4::INFINITY, self.near.max((-b - root) * inverse)),
            far: self.far.min((root - b) * inverse),
        }
    }

    pub fn is_hit(self) -> BVec4A {
        self.near.cmple(self.far)
    }
}

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Solid {
    pub shape: Shape,
    pub center: Vec3,
    /// Half sizes along the own axes.
    pub half: Vec3,
    /// Own axes as columns, of length 1.
    pub axes: Mat3,
    pub surface: usize,
    /// Point from which the coordinates of the pattern are measured; pieces of one wall share it.
    pub anchor: Vec3,
    /// World to own coordinates, without the shift.
    to_own: Mat3,
}

impl Solid {
    pub fn new(shape: Shape, center: Vec3, half: Vec3, axes: Mat3, surface: usize) -> Self {
        let half = half.max(Vec3::splat(1e-3));
        let to_own = Mat3::from_diagonal(half.recip()) * axes.transpose();
        Self { shape, center, half, axes, surface, anchor: center, to_own }
    }

    /// Returns the corners of the box around the solid, along the world's axes.
    pub fn bounds(&self) -> [Vec3; 2] {
        let reach = self.axes.x_axis.abs() * self.half.x
            + self.axes.y_axis.abs() * self.half.y
            + self.axes.z_axis.abs() * self.half.z;
        [self.center - reach, self.center + reach]
    }

    pub fn spans(&self, rays: &Rays) -> Spans {
        let m = &self.to_own;
        let from = [0, 1, 2].map(|axis| rays.origin[axis] - Vec4::splat(self.center[axis]));
        let own =
            |v: &[Vec4; 3]| [0, 1, 2].map(|row| v[0] * m.x_axis[row] + v[1] * m.y_axis[row] + v[2] * m.z_axis[row]);
        let ([ox, oy, oz], [dx, dy, dz]) = (own(&from), own(&rays.direction));
        match self.shape {
            Shape::Block => Spans::ALL.within_slab(ox, dx).within_slab(oy, dy).within_slab(oz, dz),
            Shape::Ball => Spans::ALL.within_quadric(
                dx * dx + dy * dy + dz * dz,
                ox * dx + oy * dy + oz * dz,
                ox * ox + oy * oy + oz * oz - 1.0,
            ),
            Shape::Column => {
                let spans = Spans::ALL.within_slab(oy, dy);
                spans.within_quadric(dx * dx + dz * dz, ox * dx + oz * dz, ox * ox + oz * oz - 1.0)
            }
            Shape::Roof => {
                let spans = Spans::ALL.within_slab(oz, dz).below(oy - 1.0, dy);
                let (o, d) = (oy * -0.5 - 0.5, dy * -0.5);
                spans.below(ox + o, dx + d).below(o - ox, d - dx)
            }
        }
    }

    pub fn normal(&self, point: Vec3) -> Vec3 {
        let own = self.to_own * (point - self.center);
        let outwards = match self.shape {
            Shape::Block => return self.axes * largest_axis(own),
            Shape::Ball => own,
            Shape::Column if own.y.abs() > own.x.hypot(own.z) => Vec3::Y * own.y.signum(),
            Shape::Column => Vec3::new(own.x, 0.0, own.z),
            Shape::Roof => {
                let slant = own.x.abs() - 0.5 * own.y + 0.5;
                if own.z.abs() > slant.max(own.y) {
                    Vec3::Z * own.z.signum()
                } else if own.y > slant {
                    Vec3::Y
                } else {
                    Vec3::new(own.x.signum(), -0.5, 0.0)
                }
            }
        };
        (self.to_own.transpose() * outwards).normalize_or(Vec3::NEG_Y)
    }

    /// Returns the distances of a point on the surface along two directions of the surface, in units of length.
    pub fn coordinates(&self, point: Vec3, normal: Vec3) -> [f32; 2] {
        let (own, facing) = (self.axes.transpose() * (point - self.anchor), (self.axes.transpose() * normal).abs());
        if matches!(self.shape, Shape::Ball | Shape::Column) && facing.y < 0.8 {
            let radius = 0.5 * (self.half.x + self.half.z);
            return [radius * own.z.atan2(own.x), own.y];
        }
        if facing.y > facing.x.max(facing.z) {
            [own.x, own.z]
        } else if facing.x > facing.z {
            [own.z, own.y]
        } else {
            [own.x, own.y]
        }
    }

    /// Returns a lower bound of the distance from a point to the solid; 0 inside.
    pub fn distance(&self, point: Vec3) -> f32 {
        let own = self.axes.transpose() * (point - self.center);
        match self.shape {
            Shape::Ball => ((self.to_own * (point - self.center)).length() - 1.0).max(0.0) * self.half.min_element(),
            _ => (own.abs() - self.half).max(Vec3::ZERO).length(),
        }
    }
}

fn largest_axis(v: Vec3) -> Vec3 {
    let size = v.abs();
    if size.x > size.y.max(size.z) {
        Vec3::X * v.x.signum()
    } else if size.y > size.z {
        Vec3::Y * v.y.signum()
    } else {
        Vec3::Z * v.z.signum()
    }
}
