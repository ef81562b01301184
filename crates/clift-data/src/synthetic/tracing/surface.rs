//! Patterns of surfaces, filtered by the width of a pixel so that nothing flickers.

use glam::Vec3;

use crate::synthetic::tracing::noise::{byte, edge, floor, hash, octaves, pulse, smooth, value_noise};

/// Pattern of a surface; lengths are in periods of the pattern.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Pattern {
    /// The base colour alone.
    Plain,
    /// From the base to the second colour and back.
    Gradient,
    /// Stripes of the second colour, of this share of a period.
    Stripes { duty: f32 },
    /// Translucent stripes of the second and third colour, across each other.
    Plaid { duty: f32 },
    /// A chessboard.
    Checks,
    /// Cells of one size with joints; `stretch` is width over height, every other row is shifted by `shift`.
    Bricks { stretch: f32, joint: f32, shift: f32 },
    /// Clouds of noise; `sharp` above 1 makes spots with edges.
    Clouds { gain: f32, sharp: f32 },
    /// The lines of wood.
    Grain,
    /// Signs of 3 x 5 dots in lines, as writing.
    Glyphs,
    /// Rectangles divided into rectangles, as a picture.
    Mosaic,
    /// Discs on discs of several sizes: what a photo of many things is like.
    Discs,
    /// Standing strips of different widths in rows, as books.
    Books,
    /// A grid of panes with frames, as a facade.
    Panes { width: f32, height: f32 },
    /// Sine waves, unfiltered; lengths and the phase are in radians.
    Waves { wave: Wave, phase: f32 },
}

/// Share of the second colour as a function of two angles.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Wave {
    Gradient,
    Stripes,
    Checkers,
    Ripples,
}

impl Wave {
    fn share(self, along: f32, across: f32) -> f32 {
        // Plateaus at 0 and 1 with edges wider than a pixel.
        let soft_edge = |wave: f32| smooth(0.5 + 1.2 * wave);
        match self {
            Self::Gradient => 0.5 + 0.5 * (0.5 * along).sin(),
            Self::Stripes => soft_edge(along.sin()),
            Self::Checkers => soft_edge(2.0 * (0.7 * along).sin() * (0.7 * across).sin()),
            Self::Ripples => 0.5 + 0.25 * (along.sin() + (across + along.cos()).sin()),
        }
    }
}

/// Colour of a surface as a function of two coordinates along it.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Surface {
    pub pattern: Pattern,
    /// Base, second colour, and colour of joints or marks.
    pub colors: [Vec3; 3],
    /// Periods per unit of length.
    pub rate: f32,
    /// Direction of the first axis, as (cosine, sine).
    pub turn: [f32; 2],
    pub seed: u32,
    /// Amplitude of the noise on the brightness, and its cells per unit of length.
    pub grain: f32,
    pub grain_rate: f32,
    /// 0 is matt, 1 is polished.
    pub gloss: f32,
    pub glow: f32,
}

impl Surface {
    pub fn plain(color: Vec3) -> Self {
        Self {
            pattern: Pattern::Plain,
            colors: [color; 3],
            rate: 1.0,
            turn: [1.0, 0.0],
            seed: 0,
            grain: 0.0,
            grain_rate: 1.0,
            gloss: 0.0,
            glow: 0.0,
        }
    }

    /// Returns the linear colour at `u`, `v`, averaged over about `width` units of length.
    pub fn color(&self, u: f32, v: f32, width: f32) -> Vec3 {
        let [cos, sin] = self.turn;
        let x = (u * cos + v * sin) * self.rate;
        let y = (v * cos - u * sin) * self.rate;
        let mut color = self.pattern(x, y, width * self.rate);
        if self.grain > 0.0 {
            let rate = self.grain_rate;
            let shade = 1.0 + self.grain * octaves(u * rate, v * rate, self.seed ^ 0x5bd1, 0.65, width * rate);
            color *= shade.max(0.05);
        }
        color
    }

    fn pattern(&self, x: f32, y: f32, width: f32) -> Vec3 {
        let [base, second, third] = self.colors;
        let seed = self.seed;
        match self.pattern {
            Pattern::Plain => base,
            Pattern::Gradient => {
                let t = x.rem_euclid(2.0);
                base.lerp(second, if t > 1.0 { 2.0 - t } else { t })
            }
            Pattern::Stripes { duty } => base.lerp(second, pulse(x, duty, width)),
            Pattern::Plaid { duty } => {
                let (one, other) = (pulse(x, duty, width), pulse(y, duty, width));
                base.lerp(second, one * 0.6).lerp(third, other * 0.6)
            }
            Pattern::Checks => {
                let (one, other) = (pulse(x * 0.5, 0.5, width * 0.5), pulse(y * 0.5, 0.5, width * 0.5));
                base.lerp(second, one + other - 2.0 * one * other)
            }
            Pattern::Bricks { stretch, joint, shift } => {
                let row = floor(y);
                let x = x / stretch + shift * byte(hash(row, 7, seed), 0).max(0.5 * (row & 1) as f32);
                let cell = hash(floor(x), row, seed);
                let sharp = (1.5 - width).clamp(0.0, 1.0);
                let tint = base.lerp(second, 0.5 + sharp * (byte(cell, 1) - 0.5));
                let tint = tint * (1.0 + sharp * 0.3 * (byte(cell, 2) - 0.5));
                let solid = pulse(x, 1.0 - joint / stretch, width / stretch) * pulse(y, 1.0 - joint, width);
                third.lerp(tint, solid)
            }
            Pattern::Clouds { gain, sharp } => {
                let t = 0.5 + 0.5 * sharp * octaves(x, y, seed, gain, width);
                base.lerp(second, t.clamp(0.0, 1.0))
            }
            Pattern::Grain => {
                let wave = octaves(x * 0.12, y * 1.5, seed, 0.7, width * 1.5);
                base.lerp(second, (0.5 + 0.6 * wave).clamp(0.0, 1.0))
            }
            Pattern::Glyphs => base.lerp(third, glyphs(x, y, seed, width)),
            Pattern::Mosaic => self.mosaic(x, y, width),
            Pattern::Discs => self.discs(x, y, width),
            Pattern::Books => self.books(x, y, width),
            Pattern::Panes { width: wide, height } => {
                let cell = hash(floor(x), floor(y), seed);
                let inside = |inset: f32| {
                    let (wide, tall) = (wide - inset, height - inset);
                    pulse(x - 0.5 * (1.0 - wide), wide, width) * pulse(y - 0.5 * (1.0 - tall), tall, width)
                };
                let sharp = (1.5 - width).clamp(0.0, 1.0);
                let glass = second * (1.0 + 1.2 * sharp * (byte(cell, 1) - 0.4));
                base.lerp(third, inside(0.0)).lerp(glass, inside(0.1))
            }
            Pattern::Waves { wave, phase } => base.lerp_monotonic(second, wave.share(x + phase, y)),
        }
    }

    fn mosaic(&self, x: f32, y: f32, width: f32) -> Vec3 {
        let (column, row) = (floor(x), floor(y));
        let mut state = hash(column, row, self.seed);
        let (mut x, mut y) = (x - column as f32, y - row as f32);
        let (mut wide, mut tall) = (1.0_f32, 1.0_f32);
        let mut color = self.mix(state);
        let mut weight = 0.8;
        for _ in 0..5 {
            let across = wide > tall;
            let (place, size) = if across { (&mut x, &mut wide) } else { (&mut y, &mut tall) };
            let split = *size * (0.25 + 0.5 * byte(state, 3));
            let share = edge(*place - split, width);
            let (one, other) = (hash(1, 0, state), hash(2, 0, state));
            color = color.lerp(self.mix(one).lerp(self.mix(other), share), weight);
            if *place < split {
                (*size, state) = (split, one);
            } else {
                *place -= split;
                *size -= split;
                state = other;
            }
            if size.min(1.0) < width {
                break;
            }
            weight *= 0.8;
        }
        color
    }

    fn mix(&self, state: u32) -> Vec3 {
        let tint = self.colors[0].lerp(self.colors[1], byte(state, 0));
        let tint = if state & 0x7000 == 0 { self.colors[2] } else { tint };
        tint * (0.35 + 1.1 * byte(state, 1))
    }

    fn discs(&self, x: f32, y: f32, width: f32) -> Vec3 {
        let mut color = self.colors[0];
        let mut rate = 1.0;
        for layer in 0..5 {
            let sharp = (1.5 - 1.5 * width * rate).min(1.0);
            if sharp <= 0.0 {
                break;
            }
            let (u, v) = (x * rate + 0.37 * layer as f32, y * rate + 0.61 * layer as f32);
            let (column, row) = (floor(u), floor(v));
            let cell = hash(column, row, self.seed ^ (layer * 77));
            let radius = 0.15 + 0.33 * byte(cell, 0);
            let room = 0.5 - radius;
            let du = u - column as f32 - 0.5 - room * (2.0 * byte(cell, 2) - 1.0);
            let dv = v - row as f32 - 0.5 - room * (2.0 * byte(cell, 3) - 1.0);
            let outside = if cell & 0x100 == 0 { du.hypot(dv) } else { du.abs().max(dv.abs()) };
            let covered = edge(radius - outside, width * rate) * sharp;
            color = color.lerp(self.mix(hash(3, 1, cell)), covered);
            rate *= 1.9;
        }
        color
    }

    fn books(&self, x: f32, y: f32, width: f32) -> Vec3 {
        let row = floor(y);
        let at = x * 6.0 + 0.7 * value_noise(x * 6.0, row as f32, self.seed);
        let book = hash(floor(at), row, self.seed);
        let sharp = (1.5 - 6.0 * width).clamp(0.0, 1.0);
        let tint = (self.colors[0] + self.colors[1]) * 0.4;
        let tint = tint.lerp(self.mix(book), sharp);
        let level = y - row as f32;
        let top = 0.08 + 0.25 * sharp * byte(book, 2);
        let marked = pulse(level * 3.0 + byte(book, 3), 0.15, width * 3.0) * sharp;
        let tint = tint.lerp(self.colors[2], 0.5 * marked);
        (tint * pulse(at, 0.92, 6.0 * width)).lerp(Vec3::splat(0.01), edge(top - level, width))
    }
}

/// Returns the share of ink: signs of 3 x 5 dots, six rows a line, words apart.
fn glyphs(x: f32, y: f32, seed: u32, width: f32) -> f32 {
    let (x, y) = (x * 6.0, y * 6.0);
    let width = width * 6.0;
    let visible = (1.6 - 0.8 * width).clamp(0.0, 1.0);
    let ink = |i: i32, j: i32| {
        let (sign, line) = (i.div_euclid(4), j.div_euclid(8));
        let (column, row) = (i.rem_euclid(4), j.rem_euclid(8));
        let bits = hash(sign, line, seed);
        let is_gap = column == 3 || row >= 5 || bits & 0x7_0000 == 0;
        if is_gap { 0.0 } else { ((bits >> (column * 5 + row)) & 1) as f32 }
    };
    let (i, j) = (floor(x - 0.5), floor(y - 0.5));
    let near = |place: f32| edge(place - 0.5, width.clamp(0.05, 1.0));
    let (u, v) = (near(x - 0.5 - i as f32), near(y - 0.5 - j as f32));
    let upper = ink(i, j) * (1.0 - u) + ink(i + 1, j) * u;
    let lower = ink(i, j + 1) * (1.0 - u) + ink(i + 1, j + 1) * u;
    let sharp = upper * (1.0 - v) + lower * v;
    // 25 of 64 dots of a sign are inked on average.
    0.22 + visible * (sharp - 0.22)
}

/// Converts hue (in turns), saturation and value to a linear colour, for a display gamma of 2.
pub(crate) fn linear_color(hue: f64, saturation: f64, value: f64) -> Vec3 {
    let channels = [0.0, 2.0 / 3.0, 1.0 / 3.0].map(|offset: f64| {
        let distance = ((hue + offset).rem_euclid(1.0) * 6.0 - 3.0).abs() - 1.0;
        let shade = value * (1.0 - saturation * (1.0 - distance.clamp(0.0, 1.0)));
        (shade * shade) as f32
    });
    channels.into()
}
