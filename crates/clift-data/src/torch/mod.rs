//! PyTorch files: chunks and checkpoints of `torch.save`, read without executing them, and written for `torch.load`.
//!
//! - `archive`: the ZIP archive of torch.save
//! - `values`: value types of a pickle, limits
//! - `allow_list`: Python names a pickle may use
//! - `pickle_machine`: stack, marks and memo of the unpickler
//! - `unpickler`: the opcodes of `torch.save`, bounded, without execution
//! - `objects`: opcodes of objects of unknown classes, skipped
//! - `pickle`: a parsed pickle, looked up by key
//! - `pickle_writer`: write files for torch.load
//! - `tensor_span`: byte range of a tensor
//! - `state_dict`: weights of PyTorch checkpoints
//! - `file_kind`: recognition of files that are not checkpoints

pub(crate) mod allow_list;
pub(crate) mod archive;
pub(crate) mod file_kind;
pub(crate) mod objects;
pub(crate) mod pickle;
pub(crate) mod pickle_machine;
pub(crate) mod pickle_writer;
pub(crate) mod state_dict;
pub(crate) mod tensor_span;
pub(crate) mod unpickler;
pub(crate) mod values;
