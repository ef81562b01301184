//! The unpickler: the opcodes of `torch.save`, bounded, without execution, and the Python names that a pickle may use.

use std::collections::{BTreeSet, HashMap};

use crate::torch::values::{ElementType, Global, MAX_BYTES, MAX_VALUES, Storage, Tensor, Value, ValueId};

/// Deepest nesting of unfinished lists, dicts and tuples; checkpoints contain configuration objects.
const MAX_DEPTH: usize = 256;
const MAX_DIMENSIONS: usize = 4;
/// Longest name of a storage; `torch.save` numbers the storages.
const MAX_STORAGE_KEY_BYTES: usize = 32;
const MAX_NAME_BYTES: usize = 1000;
const MAX_SKIPPED_OBJECTS: usize = 256;

const NO_OPERANDS: &str = "an opcode without its operands";

#[derive(Default)]
pub(crate) struct Unpickler<'a> {
    bytes: &'a [u8],
    at: usize,
    pub values: Vec<Value>,
    stack: Vec<ValueId>,
    marks: Vec<usize>,
    memo: HashMap<u32, ValueId>,
    pub skipped_objects: BTreeSet<String>,
}

impl<'a> Unpickler<'a> {
    /// Reads a pickle; returns the outermost value and the unpickler that holds all values.
    pub fn read(bytes: &'a [u8]) -> Result<(ValueId, Self), UnpickleError> {
        let mut unpickler = Self { bytes, ..Self::default() };
        match unpickler.run() {
            Ok(root) => Ok((root, unpickler)),
            Err(UnpickleError::Bad(what)) => Err(format!("{what} (at byte {})", unpickler.at).into()),
            Err(refused) => Err(refused),
        }
    }

    fn run(&mut self) -> Result<ValueId, UnpickleError> {
        if self.bytes.len() > MAX_BYTES {
            return Err(format!("the pickle has {} bytes, more than the limit of {MAX_BYTES}", self.bytes.len()).into());
        }
        loop {
            match self.u8()? {
                b'.' => return self.pop(),
                opcode => self.execute(opcode)?,
            }
        }
    }

    fn execute(&mut self, opcode: u8) -> Result<(), UnpickleError> {
        match opcode {
            // PROTO, FRAME (the length of a frame, not needed), MARK
            0x80 => match self.u8()? {
                2..=5 => {}
                version => return Err(format!("protocol {version}, expected 2 to 5").into()),
            },
            0x95 => drop(self.take(8)?),
            b'(' => {
                if self.marks.len() == MAX_DEPTH {
                    return Err(format!("nested deeper than {MAX_DEPTH} levels").into());
                }
                self.marks.push(self.stack.len());
            }
            // The memo, Python names, storages, calls
            b'q' | b'r' => {
                let slot = self.short_or_u32(opcode == b'q')?;
                self.remember(slot)?;
            }
            0x94 => self.remember(self.memo.len() as u32)?,
            b'h' | b'j' => {
                let slot = self.short_or_u32(opcode == b'h')?;
                let value = *self.memo.get(&slot).ok_or_else(|| format!("memo slot {slot} was never set"))?;
                self.stack.push(value);
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
                self.push(self.storage(id).unwrap_or(Value::Opaque))?;
            }
            b'R' => {
                let (arguments, callee) = (self.pop()?, self.pop()?);
                self.push(self.call(callee, arguments).unwrap_or(Value::Opaque))?;
            }
            _ => return self.read_value(opcode),
        }
        Ok(())
    }

    /// Handles the opcodes of numbers, strings, `None`, `True`, `False`, lists, dicts and tuples.
    fn read_value(&mut self, opcode: u8) -> Result<(), UnpickleError> {
        let value = match opcode {
            b'N' => Value::None,
            0x88 => Value::Bool(true),
            0x89 => Value::Bool(false),
            b'J' => Value::Int(i32::from_le_bytes(self.array()?).into()),
            b'K' => Value::Int(self.u8()?.into()),
            b'M' => Value::Int(u16::from_le_bytes(self.array()?).into()),
            0x8a => self.long()?,
            b'G' => Value::Float(f64::from_be_bytes(self.array()?)),
            b'X' | 0x8c => {
                let length = self.short_or_u32(opcode == 0x8c)?;
                Value::Str(self.text(length as usize)?)
            }
            b']' => Value::List(Vec::new()),
            b'}' => Value::Dict(Vec::new()),
            b')' => Value::Tuple(Vec::new()),
            0x85..=0x87 => {
                let mut items = (0..opcode - 0x84).map(|_| self.pop()).collect::<Result<Vec<_>, _>>()?;
                items.reverse();
                Value::Tuple(items)
            }
            b't' => Value::Tuple(self.pop_to_mark()?),
            b'a' => {
                let item = self.pop()?;
                return self.extend_list(&[item]);
            }
            b'e' => {
                let items = self.pop_to_mark()?;
                return self.extend_list(&items);
            }
            b's' => {
                let (value, key) = (self.pop()?, self.pop()?);
                return self.extend_dict(&[key, value]);
            }
            b'u' => {
                let items = self.pop_to_mark()?;
                return self.extend_dict(&items);
            }
            _ => return self.skip_object(opcode),
        };
        self.push(value)
    }

    /// Handles the opcodes of objects of any class, sets and bytes, all of which are skipped.
    fn skip_object(&mut self, opcode: u8) -> Result<(), UnpickleError> {
        match opcode {
            // BUILD: sets the state of the object below it.
            b'b' => {
                self.pop()?;
                self.top()?;
            }
            // NEWOBJ, NEWOBJ_EX: a class and its arguments.
            0x81 | 0x92 => {
                for _ in 0..if opcode == 0x81 { 2 } else { 3 } {
                    self.pop()?;
                }
                self.push(Value::Opaque)?;
            }
            // ADDITEMS, EMPTY_SET, FROZENSET
            0x90 => {
                self.pop_to_mark()?;
                self.top()?;
            }
            0x8f | 0x91 => {
                if opcode == 0x91 {
                    self.pop_to_mark()?;
                }
                self.push(Value::Opaque)?;
            }
            // SHORT_BINSTRING, SHORT_BINBYTES: one byte of length; BINSTRING, BINBYTES, LONG4: four; BINBYTES8,
            // BYTEARRAY8, BINUNICODE8: eight.
            b'U' | b'C' | b'T' | b'B' | 0x8b | 0x8e | 0x96 | 0x8d => {
                let length = match opcode {
                    0x8e | 0x96 | 0x8d => u64::from_le_bytes(self.array()?),
                    _ => self.short_or_u32(matches!(opcode, b'U' | b'C'))?.into(),
                };
                self.take(usize::try_from(length).unwrap_or(usize::MAX))?;
                self.push(Value::Opaque)?;
            }
            // POP, POP_MARK, DUP
            b'0' => drop(self.pop()?),
            b'1' => drop(self.pop_to_mark()?),
            b'2' => {
                let top = self.top()?;
                self.stack.push(top);
            }
            _ => return Err(format!("opcode {opcode:#04x}, which torch.save does not write").into()),
        }
        Ok(())
    }

    fn push_global(&mut self, module: &str, name: &str) -> Result<(), UnpickleError> {
        let value = if let Some(global) = global(module, name)? {
            Value::Global(global)
        } else {
            if self.skipped_objects.len() < MAX_SKIPPED_OBJECTS {
                self.skipped_objects.insert(escaped_name(module, name));
            }
            Value::Opaque
        };
        self.push(value)
    }

    fn get(&self, id: ValueId) -> &Value {
        &self.values[id.0 as usize]
    }

    fn push(&mut self, value: Value) -> Result<(), UnpickleError> {
        if self.values.len() == MAX_VALUES {
            return Err(format!("more than {MAX_VALUES} values").into());
        }
        self.stack.push(ValueId(self.values.len() as u32));
        self.values.push(value);
        Ok(())
    }

    fn pop(&mut self) -> Result<ValueId, UnpickleError> {
        let top = self.top()?;
        self.stack.pop();
        Ok(top)
    }

    fn pop_to_mark(&mut self) -> Result<Vec<ValueId>, UnpickleError> {
        let mark = self.marks.pop().ok_or("an opcode without its mark")?;
        Ok(self.stack.split_off(mark))
    }

    fn top(&self) -> Result<ValueId, UnpickleError> {
        let floor = self.marks.last().copied().unwrap_or(0);
        self.stack[floor..].last().copied().ok_or_else(|| NO_OPERANDS.into())
    }

    /// Appends items to the list on top of the stack. Items that are added to a skipped object are skipped as well.
    fn extend_list(&mut self, items: &[ValueId]) -> Result<(), UnpickleError> {
        let list = self.top()?;
        match &mut self.values[list.0 as usize] {
            Value::Opaque => {}
            Value::List(list) => list.extend_from_slice(items),
            _ => return Err("an append to something other than a list".into()),
        }
        Ok(())
    }

    fn extend_dict(&mut self, items: &[ValueId]) -> Result<(), UnpickleError> {
        let dict = self.top()?;
        match &mut self.values[dict.0 as usize] {
            Value::Opaque => {}
            Value::Dict(_) if !items.len().is_multiple_of(2) => return Err("a dict key without a value".into()),
            Value::Dict(dict) => dict.extend(items.chunks_exact(2).map(|pair| (pair[0], pair[1]))),
            _ => return Err("an item set on something other than a dict".into()),
        }
        Ok(())
    }

    fn remember(&mut self, slot: u32) -> Result<(), UnpickleError> {
        let value = self.top()?;
        if self.memo.len() == MAX_VALUES {
            return Err(format!("more than {MAX_VALUES} remembered values").into());
        }
        self.memo.insert(slot, value);
        Ok(())
    }

    fn take(&mut self, length: usize) -> Result<&[u8], UnpickleError> {
        let rest = &self.bytes[self.at..];
        let taken = rest.get(..length).ok_or("the pickle ends in the middle of a value")?;
        self.at += length;
        Ok(taken)
    }

    fn array<const LENGTH: usize>(&mut self) -> Result<[u8; LENGTH], UnpickleError> {
        let mut array = [0; LENGTH];
        array.copy_from_slice(self.take(LENGTH)?);
        Ok(array)
    }

    fn u8(&mut self) -> Result<u8, UnpickleError> {
        Ok(self.array::<1>()?[0])
    }

    /// Reads an unsigned integer of one byte, or of four.
    fn short_or_u32(&mut self, is_short: bool) -> Result<u32, UnpickleError> {
        Ok(if is_short { self.u8()?.into() } else { u32::from_le_bytes(self.array()?) })
    }

    /// Reads a signed integer of up to 64 bits; longer ones are skipped in checkpoints.
    fn long(&mut self) -> Result<Value, UnpickleError> {
        let length = self.u8()? as usize;
        let digits = self.take(length)?;
        let is_negative = digits.last().is_some_and(|high| high & 0x80 != 0);
        let mut extended = [if is_negative { 0xff } else { 0 }; 8];
        match extended.get_mut(..length) {
            Some(low) => low.copy_from_slice(digits),
            // More than 64 bits.
            None => return Ok(Value::Opaque),
        }
        Ok(Value::Int(i64::from_le_bytes(extended)))
    }

    fn text(&mut self, length: usize) -> Result<String, UnpickleError> {
        String::from_utf8(self.take(length)?.to_vec()).map_err(|_| "a string that is not UTF-8".into())
    }

    fn line(&mut self) -> Result<String, UnpickleError> {
        let length = self.bytes[self.at..].iter().position(|&byte| byte == b'\n');
        let line = self.text(length.ok_or("the pickle ends in the middle of a name")?)?;
        self.at += 1;
        Ok(line)
    }

    /// Reads a storage, `("storage", <storage type>, key, device, number of elements)`; `None` for anything else, which is
    /// skipped.
    fn storage(&self, id: ValueId) -> Option<Value> {
        let Value::Tuple(fields) = self.get(id) else { return None };
        let [kind, storage_type, key, _device, num_elements] = fields[..] else { return None };
        match (self.get(kind), self.get(storage_type), self.get(key), self.get(num_elements)) {
            (Value::Str(kind), Value::Global(Global::Storage(element_type)), Value::Str(key), Value::Int(count))
                if kind == "storage" && key.len() <= MAX_STORAGE_KEY_BYTES && *count >= 0 =>
            {
                Some(Value::Storage(Box::new(Storage { element_type: *element_type, key: key.clone() })))
            }
            _ => None,
        }
    }

    /// Evaluates a call of an allowed name; these calls only describe data. `None` for any other call, which is skipped.
    fn call(&self, callee: ValueId, arguments: ValueId) -> Option<Value> {
        let Value::Tuple(arguments) = self.get(arguments) else { return None };
        match (self.get(callee), &arguments[..]) {
            (Value::Global(Global::OrderedDict), []) => Some(Value::Dict(Vec::new())),
            (Value::Global(Global::RebuildTensor), [storage, offset, shape, stride, ..]) => {
                let (Value::Storage(storage), Value::Int(offset)) = (self.get(*storage), self.get(*offset)) else {
                    return None;
                };
                let (storage, offset) = ((**storage).clone(), u64::try_from(*offset).ok()?);
                let (shape, stride) = (self.counts(*shape)?, self.counts(*stride)?);
                let is_tensor = shape.len() == stride.len();
                is_tensor.then(|| Value::Tensor(Box::new(Tensor { storage, offset, shape, stride })))
            }
            (Value::Global(Global::RebuildParameter), [data, ..]) => match self.get(*data) {
                Value::Tensor(tensor) => Some(Value::Tensor(tensor.clone())),
                _ => None,
            },
            _ => None,
        }
    }

    /// Reads a tuple of at most [`MAX_DIMENSIONS`] non-negative integers.
    fn counts(&self, id: ValueId) -> Option<Vec<u64>> {
        let Value::Tuple(items) = self.get(id) else { return None };
        let count = |id: &ValueId| match self.get(*id) {
            Value::Int(count) => u64::try_from(*count).ok(),
            _ => None,
        };
        if items.len() > MAX_DIMENSIONS { None } else { items.iter().map(count).collect() }
    }
}

pub(crate) enum UnpickleError {
    /// A Python name that is not allowed.
    Refused(String),
    Bad(String),
}

impl<S: Into<String>> From<S> for UnpickleError {
    fn from(what: S) -> Self {
        Self::Bad(what.into())
    }
}

/// Looks a Python name up in the allow-list; `None` for a name whose objects are skipped.
pub(crate) fn global(module: &str, name: &str) -> Result<Option<Global>, UnpickleError> {
    Ok(Some(match (module, name) {
        ("torch._utils", "_rebuild_tensor_v2") => Global::RebuildTensor,
        ("torch._utils", "_rebuild_parameter" | "_rebuild_parameter_with_state") => Global::RebuildParameter,
        ("collections", "OrderedDict") => Global::OrderedDict,
        ("torch", "ByteStorage") => Global::Storage(ElementType::U8),
        ("torch", "IntStorage") => Global::Storage(ElementType::I32),
        ("torch", "LongStorage") => Global::Storage(ElementType::I64),
        ("torch", "FloatStorage") => Global::Storage(ElementType::F32),
        ("torch", "DoubleStorage") => Global::Storage(ElementType::F64),
        ("torch", "HalfStorage") => Global::Storage(ElementType::F16),
        ("torch", "BFloat16Storage") => Global::Storage(ElementType::BF16),
        _ if is_attack(module, name) => return Err(UnpickleError::Refused(escaped_name(module, name))),
        _ => return Ok(None),
    }))
}

/// Formats a name of a possibly hostile file: at most 120 characters, without control characters.
pub(crate) fn escaped_name(module: &str, name: &str) -> String {
    let name: String = format!("{module}.{name}").chars().take(120).collect();
    name.escape_debug().to_string()
}

/// Returns whether the file is likely an attack on programs that execute pickles: no training program writes this name.
fn is_attack(module: &str, name: &str) -> bool {
    let package = module.split('.').next().unwrap_or_default();
    match package {
        "os" | "posix" | "nt" | "subprocess" | "pty" | "commands" | "shutil" | "socket" | "runpy" | "ctypes"
        | "webbrowser" | "importlib" | "pickle" | "_pickle" | "cPickle" | "marshal" | "timeit" | "requests"
        | "http" | "ftplib" | "smtplib" | "pdb" | "bdb" | "profile" | "cProfile" | "trace" | "doctest" | "sys"
        | "multiprocessing" | "asyncio" | "pip" | "pkgutil" => true,
        "builtins" | "__builtin__" => {
            matches!(name, "eval" | "exec" | "execfile" | "compile" | "open" | "__import__" | "input" | "breakpoint")
        }
        "urllib" | "urllib2" => module != "urllib.parse",
        // A project may have a package named `code`.
        "code" => module == "code",
        "torch" => match module {
            "torch" => matches!(name, "load" | "save" | "compile"),
            "torch.serialization" => name != "_get_layout", // pickled layouts use this name
            "torch.jit" => name == "load",
            "torch.utils.cpp_extension" => true,
            _ => module.starts_with("torch.hub") || module.starts_with("torch.package"),
        },
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn attacks_differ_from_names_of_training_programs() {
        let attacks = "os.system builtins.eval _pickle.loads timeit.timeit urllib.request.urlopen requests.api.get \
                       code.interact sys.exit multiprocessing.util.spawnv_passfds torch.load torch.hub.load \
                       torch.serialization.load";
        let others = "builtins.getattr builtins.set torch.device torch.serialization._get_layout \
                      torch.optim.lr_scheduler.LambdaLR urllib.parse.ParseResult code.config.ModelConfig \
                      osgeo.osr.SpatialReference pathlib.PosixPath";
        for (names, is_refused) in [(attacks, true), (others, false)] {
            for (module, name) in names.split(' ').map(|name| name.rsplit_once('.').unwrap()) {
                let found = global(module, name);
                assert_eq!(matches!(found, Err(UnpickleError::Refused(_))), is_refused, "{module}.{name}");
            }
        }
    }
}
