//! What the pickles of checkpoints have beyond those of chunks: objects of any class, sets and bytes. All of it is
//! passed over.

use crate::torch::allow_list::UnpickleError;
use crate::torch::pickle_machine::PickleMachine;
use crate::torch::values::Value;

impl PickleMachine<'_> {
    /// Objects, sets, bytes and what else only checkpoints have.
    pub(crate) fn read_object(&mut self, opcode: u8) -> Result<bool, UnpickleError> {
        match opcode {
            // BUILD: the state of an object, which stays on the stack.
            b'b' => {
                self.pop()?;
                self.top()?;
            }
            // NEWOBJ, NEWOBJ_EX: a class and its arguments.
            0x81 => self.replace(2)?,
            0x92 => self.replace(3)?,
            // EMPTY_SET, ADDITEMS, FROZENSET
            0x8f => self.push(Value::Opaque)?,
            0x90 => {
                self.pop_to_mark()?;
                self.top()?;
            }
            0x91 => {
                self.pop_to_mark()?;
                self.push(Value::Opaque)?;
            }
            // SHORT_BINSTRING, SHORT_BINBYTES: a length of one byte; BINSTRING, BINBYTES: of four; BINBYTES8,
            // BYTEARRAY8, BINUNICODE8: of eight. LONG4 is a number of so many bytes.
            b'U' | b'C' => {
                let length = usize::from(self.u8()?);
                self.pass_over(length)?;
            }
            b'T' | b'B' | 0x8b => {
                let length = u32::from_le_bytes(self.array()?) as usize;
                self.pass_over(length)?;
            }
            0x8e | 0x96 | 0x8d => {
                let length = u64::from_le_bytes(self.array()?);
                self.pass_over(usize::try_from(length).unwrap_or(usize::MAX))?;
            }
            // POP, POP_MARK, DUP
            b'0' => {
                self.pop()?;
            }
            b'1' => {
                self.pop_to_mark()?;
            }
            b'2' => {
                let top = self.top()?;
                self.stack.push(top);
            }
            _ => return Ok(false),
        }
        Ok(true)
    }

    /// An object in the place of what it is made from.
    fn replace(&mut self, count: usize) -> Result<(), UnpickleError> {
        for _ in 0..count {
            self.pop()?;
        }
        self.push(Value::Opaque)
    }

    fn pass_over(&mut self, num_bytes: usize) -> Result<(), UnpickleError> {
        self.take(num_bytes)?;
        self.push(Value::Opaque)
    }
}
