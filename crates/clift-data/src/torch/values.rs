//! Values of a pickle, and limits of their number and size.

/// Largest size of a pickle, in bytes; a chunk of 2,000 frames has about 150 kB.
pub const MAX_BYTES: usize = 16 << 20;
/// Largest number of values of a pickle, of at most 250 bytes each; a chunk has about 15 per frame.
pub const MAX_VALUES: usize = 1 << 20;

/// Index of a value in its [`Pickle`](crate::torch::pickle::Pickle).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ValueId(pub(crate) u32);

/// Element type of a storage.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ElementType {
    /// `torch.ByteStorage`
    U8,
    /// `torch.IntStorage`
    I32,
    /// `torch.LongStorage`
    I64,
    /// `torch.FloatStorage`
    F32,
    /// `torch.DoubleStorage`
    F64,
    /// `torch.HalfStorage`,.
    F16,
    /// `torch.BFloat16Storage`,.
    BF16,
}

impl ElementType {
    /// Returns the number of bytes of one element.
    pub fn num_bytes(self) -> u64 {
        match self {
            Self::U8 => 1,
            Self::F16 | Self::BF16 => 2,
            Self::I32 | Self::F32 => 4,
            Self::I64 | Self::F64 => 8,
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Global {
    /// `torch._utils._rebuild_tensor_v2`
    RebuildTensor,
    /// `torch._utils._rebuild_parameter`, or `_rebuild_parameter_with_state`,.
    RebuildParameter,
    /// `collections.OrderedDict`
    OrderedDict,
    /// `torch.ByteStorage` and the other storage types.
    Storage(ElementType),
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Storage {
    pub element_type: ElementType,
    /// Name of the archive member below `data/`.
    pub key: String,
}

/// A tensor as a view of a storage. Counts are in elements and not checked against the archive.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Tensor {
    pub storage: Storage,
    pub offset: u64,
    pub shape: Vec<u64>,
    pub stride: Vec<u64>,
}

impl Tensor {
    /// Returns whether the elements are contiguous in row-major order; true for an empty tensor, whatever its strides.
    pub fn is_contiguous(&self) -> bool {
        if self.shape.contains(&0) {
            return true;
        }
        let mut step = 1_u64;
        self.shape.iter().zip(&self.stride).rev().all(|(&size, &stride)| {
            let fits = size <= 1 || stride == step;
            step = step.saturating_mul(size);
            fits
        })
    }
}

#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    None,
    Bool(bool),
    Int(i64),
    Float(f64),
    Str(String),
    List(Vec<ValueId>),
    Tuple(Vec<ValueId>),
    /// A dict in order of insertion; of a key that occurs twice, the later value counts.
    Dict(Vec<(ValueId, ValueId)>),
    Global(Global),
    Storage(Box<Storage>),
    Tensor(Box<Tensor>),
    /// A skipped object of an unknown class.
    Opaque,
}
