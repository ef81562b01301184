//! State of the unpickler: remaining bytes, stack, marks and memo.

use std::collections::{BTreeSet, HashMap};

use crate::torch::allow_list::{UnknownClasses, UnpickleError, escaped_name, global};
use crate::torch::values::{MAX_VALUES, Value, ValueId};

const MAX_SKIPPED_OBJECTS: usize = 256;

#[derive(Default)]
pub(crate) struct PickleMachine<'a> {
    pub bytes: &'a [u8],
    /// Position of the next byte.
    pub at: usize,
    unknown: UnknownClasses,
    pub values: Vec<Value>,
    pub stack: Vec<ValueId>,
    pub marks: Vec<usize>,
    pub memo: HashMap<u32, ValueId>,
    pub skipped_objects: BTreeSet<String>,
}

impl<'a> PickleMachine<'a> {
    pub fn new(bytes: &'a [u8], unknown: UnknownClasses) -> Self {
        Self { bytes, unknown, ..Self::default() }
    }

    pub fn skips_unknown(&self) -> bool {
        self.unknown == UnknownClasses::Skip
    }

    /// Returns whether a value is a skipped object. Items that are added to it are skipped as well.
    pub fn is_skipped(&self, id: ValueId) -> bool {
        matches!(self.get(id), Value::Opaque)
    }

    /// Replaces an error by a skipped object, if unknown classes are skipped.
    pub fn or_opaque(&self, value: Result<Value, UnpickleError>) -> Result<Value, UnpickleError> {
        if self.skips_unknown() { Ok(value.unwrap_or(Value::Opaque)) } else { value }
    }

    pub fn push_global(&mut self, module: &str, name: &str) -> Result<(), UnpickleError> {
        let value = if let Some(global) = global(module, name, self.unknown)? {
            Value::Global(global)
        } else {
            if self.skipped_objects.len() < MAX_SKIPPED_OBJECTS {
                self.skipped_objects.insert(escaped_name(module, name));
            }
            Value::Opaque
        };
        self.push(value)
    }

    pub fn get(&self, id: ValueId) -> &Value {
        &self.values[id.0 as usize]
    }

    pub fn push(&mut self, value: Value) -> Result<(), UnpickleError> {
        if self.values.len() == MAX_VALUES {
            return Err(UnpickleError::Bad(format!("more than {MAX_VALUES} values")));
        }
        self.stack.push(ValueId(self.values.len() as u32));
        self.values.push(value);
        Ok(())
    }

    pub fn pop(&mut self) -> Result<ValueId, UnpickleError> {
        if self.stack.len() == self.marks.last().copied().unwrap_or(0) {
            return Err("an opcode without its operands".into());
        }
        self.stack.pop().ok_or_else(|| "an opcode without its operands".into())
    }

    pub fn pop_to_mark(&mut self) -> Result<Vec<ValueId>, UnpickleError> {
        let mark = self.marks.pop().ok_or("an opcode without its mark")?;
        Ok(self.stack.split_off(mark))
    }

    pub fn top(&self) -> Result<ValueId, UnpickleError> {
        let floor = self.marks.last().copied().unwrap_or(0);
        self.stack[floor..].last().copied().ok_or_else(|| "an opcode without its operands".into())
    }

    pub fn extend_list(&mut self, items: &[ValueId]) -> Result<(), UnpickleError> {
        let list = self.top()?;
        if self.is_skipped(list) {
            return Ok(());
        }
        let Value::List(list) = &mut self.values[list.0 as usize] else {
            return Err("an append to something other than a list".into());
        };
        list.extend_from_slice(items);
        Ok(())
    }

    pub fn extend_dict(&mut self, items: &[ValueId]) -> Result<(), UnpickleError> {
        let dict = self.top()?;
        if self.is_skipped(dict) {
            return Ok(());
        }
        let Value::Dict(dict) = &mut self.values[dict.0 as usize] else {
            return Err("an item set on something other than a dict".into());
        };
        if !items.len().is_multiple_of(2) {
            return Err("a dict key without a value".into());
        }
        dict.extend(items.chunks_exact(2).map(|pair| (pair[0], pair[1])));
        Ok(())
    }

    pub fn remember(&mut self, slot: u32) -> Result<(), UnpickleError> {
        let value = self.top()?;
        if self.memo.len() == MAX_VALUES {
            return Err(UnpickleError::Bad(format!("more than {MAX_VALUES} remembered values")));
        }
        self.memo.insert(slot, value);
        Ok(())
    }

    pub fn recall(&mut self, slot: u32) -> Result<(), UnpickleError> {
        let value =
            *self.memo.get(&slot).ok_or_else(|| UnpickleError::Bad(format!("memo slot {slot} was never set")))?;
        self.stack.push(value);
        Ok(())
    }

    pub fn take(&mut self, length: usize) -> Result<&[u8], UnpickleError> {
        let rest = &self.bytes[self.at..];
        let taken = rest.get(..length).ok_or("the pickle ends in the middle of a value")?;
        self.at += length;
        Ok(taken)
    }

    pub fn array<const LENGTH: usize>(&mut self) -> Result<[u8; LENGTH], UnpickleError> {
        let mut array = [0; LENGTH];
        array.copy_from_slice(self.take(LENGTH)?);
        Ok(array)
    }

    pub fn u8(&mut self) -> Result<u8, UnpickleError> {
        Ok(self.array::<1>()?[0])
    }

    /// Reads an unsigned integer of one byte, or of four.
    pub fn short_or_u32(&mut self, is_short: bool) -> Result<u32, UnpickleError> {
        Ok(if is_short { self.u8()?.into() } else { u32::from_le_bytes(self.array()?) })
    }

    pub fn text(&mut self, length: usize) -> Result<String, UnpickleError> {
        String::from_utf8(self.take(length)?.to_vec()).map_err(|_| "a string that is not UTF-8".into())
    }

    /// Reads a line of text without its newline.
    pub fn line(&mut self) -> Result<String, UnpickleError> {
        let length = self.bytes[self.at..].iter().position(|&byte| byte == b'\n');
        let line = self.text(length.ok_or("the pickle ends in the middle of a name")?)?;
        self.at += 1;
        Ok(line)
    }
}
