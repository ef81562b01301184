//! Reads the pickles inside `torch.save` archives. Nothing is executed: the few opcodes that `torch.save` writes
//! build plain values, and the only Python names accepted are those of tensors, their storages and `OrderedDict`.
//!
//! Values live in one flat arena and refer to each other by [`ValueId`], so a hostile file can neither build a
//! cycle that leaks nor a nesting that overflows the stack, and the memory of a pickle is bounded by
//! [`MAX_BYTES`](crate::torch::values::MAX_BYTES) and [`MAX_VALUES`](crate::torch::values::MAX_VALUES).

use std::collections::BTreeSet;
use std::path::Path;

use crate::error::DataError;
use crate::torch::allow_list::{UnknownClasses, UnpickleError};
use crate::torch::unpickler::{Unpickled, unpickle};
use crate::torch::values::{Value, ValueId};

/// An unpickled object and everything it refers to.
#[derive(Clone, Debug)]
pub struct Pickle {
    values: Vec<Value>,
    root: ValueId,
    passed_over: BTreeSet<String>,
}

impl Pickle {
    /// Reads a pickle of protocol 2 to 5.
    ///
    /// # Errors
    /// [`DataError::RefusedGlobal`] for a Python name that is not allowed, [`DataError::BadPickle`] for everything
    /// else: unknown opcodes, calls of anything but a tensor or an empty `OrderedDict`, truncation, exceeded limits.
    /// `path` is only named in the message.
    pub fn parse(bytes: &[u8], path: &Path) -> Result<Self, DataError> {
        Self::read(bytes, path, UnknownClasses::Refuse)
    }

    /// Reads a pickle with objects of any class, such as a training program's checkpoint: those are passed over as
    /// [`Value::Opaque`]. Nothing of them is run either.
    ///
    /// # Errors
    /// As [`Pickle::parse`]; [`DataError::RefusedGlobal`] only for names whose sole use in a pickle is an attack.
    pub fn parse_checkpoint(bytes: &[u8], path: &Path) -> Result<Self, DataError> {
        Self::read(bytes, path, UnknownClasses::Skip)
    }

    fn read(bytes: &[u8], path: &Path, unknown: UnknownClasses) -> Result<Self, DataError> {
        let Unpickled { values, root, passed_over } = unpickle(bytes, unknown).map_err(|stop| match stop {
            UnpickleError::Refused(name) => DataError::RefusedGlobal { name, path: path.to_path_buf() },
            UnpickleError::Bad(what) => DataError::BadPickle { what, path: path.to_path_buf() },
        })?;
        Ok(Self { values, root, passed_over })
    }

    /// Python names that were passed over, at most a few hundred of them.
    pub fn passed_over(&self) -> &BTreeSet<String> {
        &self.passed_over
    }

    /// The outermost object.
    pub fn root(&self) -> &Value {
        self.get(self.root)
    }

    /// A value of this pickle.
    pub fn get(&self, id: ValueId) -> &Value {
        &self.values[id.0 as usize]
    }

    /// What a dict holds under a string key; `None` for a missing key and for anything but a dict.
    pub fn item(&self, dict: &Value, key: &str) -> Option<&Value> {
        let Value::Dict(items) = dict else { return None };
        let (_, value) = items.iter().rev().find(|(k, _)| matches!(self.get(*k), Value::Str(name) if name == key))?;
        Some(self.get(*value))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

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
    fn a_valid_pickle_gives_its_values() {
        let pickle = parse(VALID).unwrap();
        let Value::List(items) = pickle.root() else { panic!("{:?}", pickle.root()) };
        let values: Vec<&Value> = items.iter().map(|id| pickle.get(*id)).collect();
        assert_eq!(
            values[1..],
            [&Value::Int(-2), &Value::Int(1 << 40), &Value::Float(0.5), &Value::None, &Value::Bool(true)]
        );
        let storage = Storage { element_type: ElementType::F32, key: "7".into(), num_elements: 10 };
        let tensor = Tensor { storage, offset: 4, shape: vec![2, 3], stride: vec![3, 1] };
        assert!(tensor.is_contiguous());
        assert_eq!(pickle.item(values[0], "x"), Some(&Value::Tensor(Box::new(tensor))));
        assert_eq!(pickle.item(values[0], "y"), None);
    }

    #[test]
    fn newer_protocols_name_globals_from_the_stack() {
        let bytes =
            b"\x80\x04\x95\x00\x00\x00\x00\x00\x00\x00\x00\x8c\x0bcollections\x94\x8c\x0bOrderedDict\x94\x93)R.";
        assert_eq!(parse(bytes).unwrap().root(), &Value::Dict(Vec::new()));
    }

    #[test]
    fn a_pickle_that_calls_os_system_is_refused_by_name() {
        let message = message(b"\x80\x02cos\nsystem\nX\x02\x00\x00\x00ls\x85R.");
        assert!(message.contains("`os.system`") && message.contains("nothing was run"), "{message}");
        assert!(message.ends_with("some.torch"), "{message}");
    }

    #[test]
    fn a_pickle_that_hides_a_name_behind_the_stack_is_refused_too() {
        let message = message(b"\x80\x04\x8c\x08builtins\x8c\x04eval\x93.");
        assert!(message.contains("`builtins.eval`"), "{message}");
    }

    #[test]
    fn an_allowed_name_cannot_be_called_with_other_arguments() {
        let message = message(b"\x80\x02ccollections\nOrderedDict\n]\x85R.");
        assert!(message.contains("a call of something other than"), "{message}");
    }

    #[test]
    fn every_truncation_of_a_valid_pickle_is_an_error() {
        for length in 0..VALID.len() {
            assert!(message(&VALID[..length]).contains("bad pickle: it ends in the middle of"), "{length}");
        }
    }

    #[test]
    fn each_limit_is_an_error_that_names_it() {
        assert!(message(&[b'('; 100]).contains("nested deeper than 32"));
        assert!(message(&vec![b'N'; MAX_VALUES + 1]).contains("more than 1048576 values"));
        assert!(message(&vec![b'N'; MAX_BYTES + 1]).contains("more than the limit of 16777216"));
        assert!(message(b"\x8a\x09\x00\x00\x00\x00\x00\x00\x00\x00\x01.").contains("more than 64 bits"));
        assert!(message(b"\x80\x01.").contains("protocol 1, expected 2 to 5"));
        assert!(message(b"\x80\x02i").contains("opcode 0x69, which torch.save does not write"));
        assert!(message(b"\x80\x02(K\x01a.").contains("an opcode without its operands"));
        assert!(message(b"\x80\x02h\x05.").contains("memo slot 5 was never set"));
    }

    /// Whole opcodes, so that random sequences get further than the first byte.
    fn opcode() -> impl Strategy<Value = Vec<u8>> {
        let short = b"(N]})\x85\x86\x87taesu\x94RQ\x93".iter().map(|opcode| vec![*opcode]);
        let long: [&[u8]; 8] = [
            b"K\x02",
            b"q\x01",
            b"h\x01",
            b"J\xff\xff\xff\xff",
            b"X\x07\x00\x00\x00storage",
            b"ctorch\nByteStorage\n",
            b"ccollections\nOrderedDict\n",
            b"ctorch._utils\n_rebuild_tensor_v2\n",
        ];
        proptest::sample::select(short.chain(long.map(<[u8]>::to_vec)).collect::<Vec<_>>())
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(2000))]

        #[test]
        fn random_bytes_never_panic(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
            let _ = parse(&bytes);
        }

        #[test]
        fn random_opcodes_never_panic(opcodes in proptest::collection::vec(opcode(), 0..60)) {
            let mut bytes = opcodes.concat();
            bytes.push(b'.');
            let _ = parse(&bytes);
        }

        #[test]
        fn a_valid_pickle_with_bytes_changed_never_panics(
            changes in proptest::collection::vec((0..VALID.len(), any::<u8>()), 1..6),
        ) {
            let mut bytes = VALID.to_vec();
            for (at, byte) in changes {
                bytes[at] = byte;
            }
            let _ = parse(&bytes);
        }
    }
}
