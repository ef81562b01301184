//! Buffers that kernels read and write.

use cubecl::ir::ElemType;
use cubecl::prelude::*;
use cubecl::server::Handle;

use crate::ledger::count_argument;

/// Type of the values of a buffer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Values {
    /// 4 bytes.
    F32,
    /// 2 bytes.
    F16,
}

impl Values {
    pub(crate) fn bytes(self) -> usize {
        match self {
            Self::F32 => 4,
            Self::F16 => 2,
        }
    }

    pub(crate) fn elem(self) -> ElemType {
        match self {
            Self::F32 => f32::elem_type_native(),
            Self::F16 => half::f16::elem_type_native(),
        }
    }
}

/// A buffer on a device.
#[derive(Clone, Debug)]
pub struct Buffer {
    /// The memory.
    pub handle: Handle,
    /// Number of values.
    pub len: usize,
    /// Type of the values.
    pub values: Values,
}

impl Buffer {
    /// Allocates a buffer; its values are undefined.
    pub fn empty(client: &Client, len: usize, values: Values) -> Self {
        Self { handle: client.empty(len.max(1) * values.bytes()), len, values }
    }

    /// Returns the buffer as an argument of vectors of `width` values.
    pub(crate) fn arg(&self, width: usize) -> BufferArg {
        count_argument(self.len * self.values.bytes());
        // SAFETY: the buffer has `len` values.
        unsafe { BufferArg::from_raw_parts(self.handle.clone(), self.len / width) }
    }
}

/// Matrices in a buffer, one a batch: value `(row, column)` of matrix `b` is at
/// `start + b * batch_stride + row * stride + column`, of a transposed matrix at `.. + row + column * stride`.
#[derive(Clone, Debug)]
pub struct Matrices<'a> {
    /// The values.
    pub buffer: &'a Buffer,
    /// Offset of the first value.
    pub start: usize,
    /// Values between two matrices; 0 for one matrix that all batches share.
    pub batch_stride: usize,
    /// Values between two rows, or two columns of a transposed matrix.
    pub stride: usize,
    /// The values of a column, not of a row, lie side by side.
    pub transposed: bool,
}

impl<'a> Matrices<'a> {
    /// Returns one matrix of `columns` columns, row after row.
    pub fn contiguous(buffer: &'a Buffer, columns: usize) -> Self {
        Self { buffer, start: 0, batch_stride: 0, stride: columns, transposed: false }
    }

    /// Returns 4 if every group of four values, of a `rows x columns` matrix, that begins at a multiple of four is one
    /// vector of the buffer, and 1 otherwise.
    pub(crate) fn width(&self, [rows, columns]: [usize; 2]) -> usize {
        let inner = if self.transposed { rows } else { columns };
        let offsets = [self.start, self.batch_stride, self.stride, inner, self.buffer.len];
        if offsets.iter().all(|offset| offset.is_multiple_of(4)) { 4 } else { 1 }
    }
}
