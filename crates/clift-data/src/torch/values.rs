//! Values of a pickle, and the limits of their number and size.

/// Largest pickle that is read; a chunk of 2,000 frames has about 150 kB.
pub const MAX_BYTES: usize = 16 << 20;
/// Most values one pickle may build, of at most 250 bytes each; a chunk has about 15 per frame.
pub const MAX_VALUES: usize = 1 << 20;

/// Place of a value in its [`Pickle`](crate::torch::pickle::Pickle).
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
    /// `torch.HalfStorage`, in checkpoints alone.
    F16,
    /// `torch.BFloat16Storage`, in checkpoints alone.
    BF16,
}

impl ElementType {
    /// Bytes of one element.
    pub fn num_bytes(self) -> u64 {
        match self {
            Self::U8 => 1,
            Self::F16 | Self::BF16 => 2,
            Self::I32 | Self::F32 => 4,
            Self::I64 | Self::F64 => 8,
        }
    }
}

/// A Python name from the allow-list.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Global {
    /// `torch._utils._rebuild_tensor_v2`
    RebuildTensor,
    /// `torch._utils._rebuild_parameter`, or `_rebuild_parameter_with_state` of one with attributes, in checkpoints alone.
    RebuildParameter,
    /// `collections.OrderedDict`
    OrderedDict,
    /// `torch.ByteStorage` and its like.
    Storage(ElementType),
}

/// A storage that the archive keeps beside the pickle.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Storage {
    /// Type of its elements.
    pub element_type: ElementType,
    /// Name of its archive member, below `data/`.
    pub key: String,
    /// How many elements the pickle says it has.
    pub num_elements: u64,
}

/// A tensor as a view of a storage; counts are in elements and not yet checked against the archive.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Tensor {
    /// Where its elements are.
    pub storage: Storage,
    /// First element.
    pub offset: u64,
    /// Sizes of its dimensions.
    pub shape: Vec<u64>,
    /// Steps between neighbours, one per dimension.
    pub stride: Vec<u64>,
}

impl Tensor {
    /// Whether its elements lie one after the other, in row-major order.
    pub fn is_contiguous(&self) -> bool {
        let mut step = 1_u64;
        self.shape.iter().zip(&self.stride).rev().all(|(&size, &stride)| {
            let fits = size <= 1 || stride == step;
            step = step.saturating_mul(size);
            fits
        })
    }
}

/// One unpickled value.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// `None`
    None,
    /// `True` or `False`
    Bool(bool),
    /// An integer of at most 64 bits.
    Int(i64),
    /// A float.
    Float(f64),
    /// A string.
    Str(String),
    /// A list.
    List(Vec<ValueId>),
    /// A tuple.
    Tuple(Vec<ValueId>),
    /// A dict in order of insertion; a key that is set twice is in it twice, and the later one counts.
    Dict(Vec<(ValueId, ValueId)>),
    /// A Python name.
    Global(Global),
    /// A storage.
    Storage(Box<Storage>),
    /// A tensor.
    Tensor(Box<Tensor>),
    /// Something of a checkpoint that was passed over: an object of a class that is not known, what was made from it.
    Opaque,
}
