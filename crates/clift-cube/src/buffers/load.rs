//! Loads of vectors with bounds.

use cubecl::prelude::*;

/// Four values.
pub(crate) type Four<F> = Vector<F, Const<4>>;

/// Position of a batch's matrix in a buffer: lines of values side by side, `stride` apart.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
pub(crate) struct Lines {
    pub(crate) start: usize,
    pub(crate) batch_stride: usize,
    pub(crate) stride: usize,
}

/// Lines of an operand that a cube reads, zeros at and after the limit. `start` is the offset of line 0.
#[derive(CubeType, Clone, Copy)]
pub(crate) struct Side {
    pub(crate) start: usize,
    pub(crate) stride: usize,
    pub(crate) first: usize,
    pub(crate) limit: usize,
}

/// Loads values `inner .. inner + 4` of line `outer`, zeros at and after the limits. `start` is the offset of line 0.
#[cube]
pub(crate) fn load_four<E: Numeric, V: Size, S: Float>(
    from: &[Vector<E, V>],
    start: usize,
    stride: usize,
    outer: usize,
    inner: usize,
    outer_limit: usize,
    inner_limit: usize,
) -> Four<S> {
    let mut result = Four::<S>::new(S::new(0.0));
    let index = start + outer * stride + inner;
    if outer < outer_limit {
        let width = V::value().comptime();
        if comptime!(width == 4) {
            if inner < inner_limit {
                result = Four::<S>::cast_from(from[index / 4]);
            }
        } else {
            #[unroll]
            for i in 0..4 {
                if inner + i < inner_limit {
                    result.insert(i, S::cast_from(from[index + i].extract(0usize)));
                }
            }
        }
    }
    result
}
