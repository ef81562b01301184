//! Opcodes of `torch.save`, executed on a [`PickleMachine`].

use crate::torch::allow_list::{UnknownClasses, UnpickleError};
use crate::torch::pickle_machine::PickleMachine;
use crate::torch::values::{Global, MAX_BYTES, Storage, Tensor, Value, ValueId};

/// Deepest nesting of unfinished lists, dicts and tuples in chunks, which need five levels.
const MAX_DEPTH: usize = 32;
/// Deepest nesting in checkpoints, which contain configuration objects.
const MAX_CHECKPOINT_DEPTH: usize = 256;
const MAX_DIMENSIONS: usize = 4;
/// Longest name of a storage; `torch.save` numbers the storages.
const MAX_STORAGE_KEY_BYTES: usize = 32;
/// Longest module or name of a Python object.
const MAX_NAME_BYTES: usize = 1000;

/// Reads a pickle; returns the outermost value and the machine that holds all values.
pub(crate) fn unpickle(bytes: &[u8], unknown: UnknownClasses) -> Result<(ValueId, PickleMachine<'_>), UnpickleError> {
    let mut machine = PickleMachine::new(bytes, unknown);
    match machine.run() {
        Ok(root) => Ok((root, machine)),
        Err(UnpickleError::Bad(what)) => Err(UnpickleError::Bad(format!("{what} (at byte {})", machine.at))),
        Err(refused) => Err(refused),
    }
}

impl PickleMachine<'_> {
    fn run(&mut self) -> Result<ValueId, UnpickleError> {
        if self.bytes.len() > MAX_BYTES {
            let what = format!("the pickle has {} bytes, more than the limit of {MAX_BYTES}", self.bytes.len());
            return Err(UnpickleError::Bad(what));
        }
        let max_depth = if self.skips_unknown() { MAX_CHECKPOINT_DEPTH } else { MAX_DEPTH };
        loop {
            match self.u8()? {
                b'.' => return self.pop(),
                0x80 => match self.u8()? {
                    2..=5 => {}
                    version => return Err(UnpickleError::Bad(format!("protocol {version}, expected 2 to 5"))),
                },
                0x95 => drop(self.take(8)?), // FRAME: the length of a frame, not needed
                b'(' if self.marks.len() == max_depth => {
                    return Err(UnpickleError::Bad(format!("nested deeper than {max_depth} levels")));
                }
                b'(' => self.marks.push(self.stack.len()),
                opcode => {
                    let known = self.read_scalar(opcode)?
                        || self.read_container(opcode)?
                        || self.read_reference(opcode)?
                        || self.skips_unknown() && self.read_object(opcode)?;
                    if !known {
                        let what = format!("opcode {opcode:#04x}, which torch.save does not write");
                        return Err(UnpickleError::Bad(what));
                    }
                }
            }
        }
    }

    /// Handles the opcodes of numbers, strings, `None`, `True` and `False`; returns false for another opcode.
    fn read_scalar(&mut self, opcode: u8) -> Result<bool, UnpickleError> {
        let value = match opcode {
            b'N' => Value::None,
            0x88 => Value::Bool(true),
            0x89 => Value::Bool(false),
            b'J' => Value::Int(i64::from(i32::from_le_bytes(self.array()?))),
            b'K' => Value::Int(i64::from(self.u8()?)),
            b'M' => Value::Int(i64::from(u16::from_le_bytes(self.array()?))),
            0x8a => {
                let length = self.u8()? as usize;
                let digits = self.take(length)?;
                if length > 8 {
                    if !self.skips_unknown() {
                        return Err("an integer of more than 64 bits".into());
                    }
                    self.push(Value::Opaque)?;
                    return Ok(true);
                }
                let digits = digits.to_vec();
                let negative = digits.last().is_some_and(|high| high & 0x80 != 0);
                let mut extended = [if negative { 0xff } else { 0 }; 8];
                extended[..length].copy_from_slice(&digits);
                Value::Int(i64::from_le_bytes(extended))
            }
            b'G' => Value::Float(f64::from_be_bytes(self.array()?)),
            b'X' | 0x8c => {
                let length = self.short_or_u32(opcode == 0x8c)?;
                Value::Str(self.text(length as usize)?)
            }
            _ => return Ok(false),
        };
        self.push(value)?;
        Ok(true)
    }

    /// Handles the opcodes of lists, tuples and dicts; returns false for another opcode.
    fn read_container(&mut self, opcode: u8) -> Result<bool, UnpickleError> {
        match opcode {
            b']' => self.push(Value::List(Vec::new()))?,
            b'}' => self.push(Value::Dict(Vec::new()))?,
            b')' => self.push(Value::Tuple(Vec::new()))?,
            0x85..=0x87 => {
                let mut items = Vec::new();
                for _ in 0..opcode - 0x84 {
                    items.push(self.pop()?);
                }
                items.reverse();
                self.push(Value::Tuple(items))?;
            }
            b't' => {
                let items = self.pop_to_mark()?;
                self.push(Value::Tuple(items))?;
            }
            b'a' => {
                let item = self.pop()?;
                self.extend_list(&[item])?;
            }
            b'e' => {
                let items = self.pop_to_mark()?;
                self.extend_list(&items)?;
            }
            b's' => {
                let (value, key) = (self.pop()?, self.pop()?);
                self.extend_dict(&[key, value])?;
            }
            b'u' => {
                let items = self.pop_to_mark()?;
                self.extend_dict(&items)?;
            }
            _ => return Ok(false),
        }
        Ok(true)
    }

    /// Handles the opcodes of the memo, Python names, storages and calls; returns false for another opcode.
    fn read_reference(&mut self, opcode: u8) -> Result<bool, UnpickleError> {
        match opcode {
            b'q' | b'r' => {
                let slot = self.short_or_u32(opcode == b'q')?;
                self.remember(slot)?;
            }
            0x94 => self.remember(self.memo.len() as u32)?,
            b'h' | b'j' => {
                let slot = self.short_or_u32(opcode == b'h')?;
                self.recall(slot)?;
            }
            b'c' => {
                let (module, name) = (self.line()?, self.line()?);
                self.push_global(&module, &name)?;
            }
            0x93 => {
                let (name, module) = (self.pop()?, self.pop()?);
                let (Value::Str(name), Value::Str(module)) = (self.get(name), self.get(module)) else {
                    return Err("a Python name that is not a string".into());
                };
                // Copied at every use: one long string could be used a million times.
                if module.len().max(name.len()) > MAX_NAME_BYTES {
                    return Err("a Python name of more than 1,000 bytes".into());
                }
                let (module, name) = (module.clone(), name.clone());
                self.push_global(&module, &name)?;
            }
            b'Q' => {
                let id = self.pop()?;
                let storage = self.storage(id).map(|storage| Value::Storage(Box::new(storage)));
                let value = self.or_opaque(storage)?;
                self.push(value)?;
            }
            b'R' => {
                let (arguments, callee) = (self.pop()?, self.pop()?);
                let value = self.or_opaque(self.call(callee, arguments))?;
                self.push(value)?;
            }
            _ => return Ok(false),
        }
        Ok(true)
    }

    /// Reads a storage: `("storage", <storage type>, key, device, number of elements)`.
    fn storage(&self, id: ValueId) -> Result<Storage, UnpickleError> {
        let Value::Tuple(fields) = self.get(id) else { return Err("a storage that is not a tuple".into()) };
        let [kind, storage_type, key, _device, num_elements] = fields[..] else {
            return Err(UnpickleError::Bad(format!("a storage of {} fields, expected 5", fields.len())));
        };
        match (self.get(kind), self.get(storage_type), self.get(key), self.get(num_elements)) {
            (Value::Str(kind), Value::Global(Global::Storage(element_type)), Value::Str(key), Value::Int(count))
                if kind == "storage" && key.len() <= MAX_STORAGE_KEY_BYTES && *count >= 0 =>
            {
                Ok(Storage { element_type: *element_type, key: key.clone(), num_elements: *count as u64 })
            }
            _ => Err("a storage whose fields are not (\"storage\", type, name, device, count)".into()),
        }
    }

    /// Evaluates a call of an allowed name; these calls only describe data.
    fn call(&self, callee: ValueId, arguments: ValueId) -> Result<Value, UnpickleError> {
        let Value::Tuple(arguments) = self.get(arguments) else {
            return Err("a call whose arguments are not a tuple".into());
        };
        match (self.get(callee), &arguments[..]) {
            (Value::Global(Global::OrderedDict), []) => Ok(Value::Dict(Vec::new())),
            (Value::Global(Global::RebuildTensor), [storage, offset, shape, stride, ..]) => {
                let (Value::Storage(storage), Value::Int(offset)) = (self.get(*storage), self.get(*offset)) else {
                    return Err("a tensor without a storage".into());
                };
                let offset =
                    u64::try_from(*offset).map_err(|_| UnpickleError::from("a tensor with a negative offset"))?;
                let (shape, stride) = (self.counts(*shape)?, self.counts(*stride)?);
                if shape.len() != stride.len() {
                    return Err("a tensor with more sizes than strides, or fewer".into());
                }
                Ok(Value::Tensor(Box::new(Tensor { storage: (**storage).clone(), offset, shape, stride })))
            }
            (Value::Global(Global::RebuildParameter), [data, ..]) => match self.get(*data) {
                Value::Tensor(tensor) => Ok(Value::Tensor(tensor.clone())),
                _ => Err("a parameter without a tensor".into()),
            },
            _ => Err("a call of something other than a tensor or an empty OrderedDict".into()),
        }
    }

    /// Reads a tuple of at most [`MAX_DIMENSIONS`] non-negative integers.
    fn counts(&self, id: ValueId) -> Result<Vec<u64>, UnpickleError> {
        let Value::Tuple(items) = self.get(id) else { return Err("a tensor whose sizes are not a tuple".into()) };
        if items.len() > MAX_DIMENSIONS {
            let what = format!("a tensor of {} dimensions, more than {MAX_DIMENSIONS}", items.len());
            return Err(UnpickleError::Bad(what));
        }
        let count = |id: &ValueId| match self.get(*id) {
            Value::Int(count) => u64::try_from(*count).map_err(|_| "a tensor with a negative size or stride".into()),
            _ => Err("a tensor with a size or stride that is not an integer".into()),
        };
        items.iter().map(count).collect()
    }
}
