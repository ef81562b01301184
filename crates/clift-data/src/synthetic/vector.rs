//! A vector of three f32: enough for tracing rays through a room a few units wide.

use std::ops::{Add, Mul, Neg, Sub};

/// A point, a direction or a linear colour.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Vector(pub [f32; 3]);

impl Vector {
    pub const ZERO: Self = Self([0.0; 3]);
    pub const ONE: Self = Self([1.0; 3]);

    pub fn from_f64(value: [f64; 3]) -> Self {
        Self(value.map(|x| x as f32))
    }

    pub fn dot(self, other: Self) -> f32 {
        self.0[0] * other.0[0] + self.0[1] * other.0[1] + self.0[2] * other.0[2]
    }

    pub fn length(self) -> f32 {
        self.dot(self).sqrt()
    }

    /// Expects a vector that is not zero.
    pub fn unit(self) -> Self {
        self * (1.0 / self.length())
    }

    /// `self` where `share` is 0, `other` where it is 1.
    pub fn mix(self, other: Self, share: f32) -> Self {
        self + (other - self) * share
    }

    /// The direction of a ray mirrored at a surface with this unit `normal`.
    pub fn mirrored(self, normal: Self) -> Self {
        self - normal * (2.0 * self.dot(normal))
    }

    /// Turned about the vertical axis; `turn` is (cosine, sine).
    pub fn turned(self, turn: [f32; 2]) -> Self {
        let ([x, y, z], [cos, sin]) = (self.0, turn);
        Self([cos * x + sin * z, y, cos * z - sin * x])
    }
}

impl Add for Vector {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self([0, 1, 2].map(|i| self.0[i] + other.0[i]))
    }
}

impl Sub for Vector {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        Self([0, 1, 2].map(|i| self.0[i] - other.0[i]))
    }
}

impl Mul<f32> for Vector {
    type Output = Self;
    fn mul(self, factor: f32) -> Self {
        Self(self.0.map(|x| x * factor))
    }
}

impl Neg for Vector {
    type Output = Self;
    fn neg(self) -> Self {
        self * -1.0
    }
}
