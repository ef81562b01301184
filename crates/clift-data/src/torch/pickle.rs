//! Values of a pickle inside a `torch.save` archive, parsed without execution, with limits of their number and size.

use std::collections::BTreeSet;
use std::path::Path;

use crate::error::DataError;
use crate::torch::unpickler::{UnpickleError, Unpickler};
use crate::torch::values::{Value, ValueId};

/// An unpickled object with all values that it refers to.
#[derive(Clone, Debug)]
pub struct Pickle {
    values: Vec<Value>,
    root: ValueId,
    /// Python names of skipped objects, at most 256.
    pub(crate) skipped_objects: BTreeSet<String>,
}

impl Pickle {
    /// Reads a pickle of protocol 2 to 5, as of chunks and checkpoints. Objects of unknown classes become opaque values and are
    /// not executed.
    ///
    /// # Errors
    /// [`DataError::RefusedGlobal`] for a Python name that only attacks use, and [`DataError::BadPickle`] for unknown opcodes,
    /// truncation, and exceeded limits. Messages name `path`.
    pub fn parse(bytes: &[u8], path: &Path) -> Result<Self, DataError> {
        match Unpickler::read(bytes) {
            Ok((root, Unpickler { values, skipped_objects, .. })) => Ok(Self { values, root, skipped_objects }),
            Err(UnpickleError::Refused(name)) => Err(DataError::RefusedGlobal { name, path: path.to_path_buf() }),
            Err(UnpickleError::Bad(what)) => Err(DataError::BadPickle { what, path: path.to_path_buf() }),
        }
    }

    /// Returns the outermost object.
    pub fn root(&self) -> &Value {
        self.get(self.root)
    }

    /// Returns a value of this pickle.
    pub fn get(&self, id: ValueId) -> &Value {
        &self.values[id.0 as usize]
    }

    /// Returns the value of a string key in a dict; `None` for a missing key or another value than a dict.
    pub fn item(&self, dict: &Value, key: &str) -> Option<&Value> {
        let Value::Dict(items) = dict else { return None };
        let (_, value) = items.iter().rev().find(|(k, _)| matches!(self.get(*k), Value::Str(name) if name == key))?;
        Some(self.get(*value))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::torch::values::{ElementType, MAX_BYTES, MAX_VALUES, Storage, Tensor};

    /// `[{"x": tensor [2, 3] of storage 7 at 4}, -2, 2**40, 0.5, None, True]` as protocol 2 writes it.
    const VALID: &[u8] = b"\x80\x02]q\x00(}X\x01\x00\x00\x00xctorch._utils\n_rebuild_tensor_v2\n\
        ((X\x07\x00\x00\x00storagectorch\nFloatStorage\nX\x01\x00\x00\x007X\x03\x00\x00\x00cpuK\x0atQ\
        K\x04K\x02K\x03\x86K\x03K\x01\x86\x89ccollections\nOrderedDict\n)RtR\
        sJ\xfe\xff\xff\xff\x8a\x06\x00\x00\x00\x00\x00\x01G\x3f\xe0\x00\x00\x00\x00\x00\x00N\x88e.";

    fn parse(bytes: &[u8]) -> Result<Pickle, DataError> {
        Pickle::parse(bytes, Path::new("some.torch"))
    }

    fn message(bytes: &[u8]) -> String {
        parse(bytes).unwrap_err().to_string()
    }

    #[test]
    fn valid_pickles_give_their_values() {
        let pickle = parse(VALID).unwrap();
        let Value::List(items) = pickle.root() else { panic!("{:?}", pickle.root()) };
        let values: Vec<&Value> = items.iter().map(|id| pickle.get(*id)).collect();
        assert_eq!(
            values[1..],
            [&Value::Int(-2), &Value::Int(1 << 40), &Value::Float(0.5), &Value::None, &Value::Bool(true)]
        );
        let storage = Storage { element_type: ElementType::F32, key: "7".into() };
        let tensor = Tensor { storage, offset: 4, shape: vec![2, 3], stride: vec![3, 1] };
        assert!(tensor.is_contiguous());
        assert_eq!(pickle.item(values[0], "x"), Some(&Value::Tensor(Box::new(tensor))));
        assert_eq!(pickle.item(values[0], "y"), None);
        // Newer protocols take names from the stack.
        let newer =
            b"\x80\x04\x95\x00\x00\x00\x00\x00\x00\x00\x00\x8c\x0bcollections\x94\x8c\x0bOrderedDict\x94\x93)R.";
        assert_eq!(parse(newer).unwrap().root(), &Value::Dict(Vec::new()));
    }

    #[test]
    fn every_truncation_is_an_error() {
        for length in 0..VALID.len() {
            assert!(message(&VALID[..length]).contains("bad pickle: the pickle ends in the middle of"), "{length}");
        }
    }

    #[test]
    fn errors_name_the_exceeded_limit() {
        assert!(message(&[b'('; 300]).contains("nested deeper than 256"));
        assert!(message(&vec![b'N'; MAX_VALUES + 1]).contains("more than 1048576 values"));
        assert!(message(&vec![b'N'; MAX_BYTES + 1]).contains("more than the limit of 16777216"));
        assert!(message(b"\x80\x01.").contains("protocol 1, expected 2 to 5"));
        assert!(message(b"\x80\x02i").contains("opcode 0x69, which torch.save does not write"));
        assert!(message(b"\x80\x02(K\x01a.").contains("an opcode without its operands"));
        assert!(message(b"\x80\x02h\x05.").contains("memo slot 5 was never set"));
    }
}
