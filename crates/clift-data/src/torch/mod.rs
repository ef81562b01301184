//! PyTorch files: chunks and checkpoints of `torch.save`, read without executing them, and written for `torch.load`.
//!
//! - `archive`: the ZIP archive of torch.save
//! - `values`: values of a pickle
//! - `unpickler`: the opcodes of `torch.save`, bounded, without execution
//! - `pickle`: a parsed pickle, looked up by key
//! - `pickle_writer`: write files for torch.load
//! - `state_dict`: weights of PyTorch checkpoints
//! - `file_kind`: recognition of files that are not checkpoints

pub(crate) mod archive;
pub(crate) mod file_kind;
pub(crate) mod pickle;
pub(crate) mod pickle_writer;
pub(crate) mod state_dict;
pub(crate) mod unpickler;
pub(crate) mod values;
