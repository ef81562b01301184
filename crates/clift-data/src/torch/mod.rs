//! PyTorch files, read without running them.
//!
//! - `archive`: the ZIP archive of torch.save
//! - `values`: value types of a pickle, limits
//! - `allow_list`: Python names a pickle may use
//! - `unpickler`: bounded pickle machine, runs nothing
//! - `objects`: skip objects of unknown classes
//! - `pickle`: a parsed pickle, looked up by key
//! - `pickle_writer`: write files for torch.load
//! - `tensor_span`: byte range of a tensor
//! - `state_dict`: weights of PyTorch checkpoints
//! - `file_kind`: recognise files that are no checkpoint

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
