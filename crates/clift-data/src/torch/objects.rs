//! Opcodes that occur in checkpoints but not in chunks: objects of any class, sets and bytes. All are skipped.

use crate::torch::allow_list::UnpickleError;
use crate::torch::pickle_machine::PickleMachine;
use crate::torch::values::Value;

impl PickleMachine<'_> {
    /// Handles the opcodes of objects, sets and bytes; returns false for another opcode.
    pub(crate) fn read_object(&mut self, opcode: u8) -> Result<bool, UnpickleError> {
        match opcode {
            // BUILD: sets the state of the object below it.
            b'b' => {
                self.pop()?;
                self.top()?;
            }
            // NEWOBJ, NEWOBJ_EX: a class and its arguments.
            0x81 => self.replace_by_opaque(2)?,
            0x92 => self.replace_by_opaque(3)?,
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
            // SHORT_BINSTRING, SHORT_BINBYTES: one byte of length; BINSTRING, BINBYTES, LONG4: four; BINBYTES8,
            // BYTEARRAY8, BINUNICODE8: eight.
            b'U' | b'C' | b'T' | b'B' | 0x8b => {
                let length = self.short_or_u32(matches!(opcode, b'U' | b'C'))?;
                self.skip_bytes(length as usize)?;
            }
            0x8e | 0x96 | 0x8d => {
                let length = u64::from_le_bytes(self.array()?);
                self.skip_bytes(usize::try_from(length).unwrap_or(usize::MAX))?;
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

    /// Replaces the top `count` values by one skipped object.
    fn replace_by_opaque(&mut self, count: usize) -> Result<(), UnpickleError> {
        for _ in 0..count {
            self.pop()?;
        }
        self.push(Value::Opaque)
    }

    fn skip_bytes(&mut self, num_bytes: usize) -> Result<(), UnpickleError> {
        self.take(num_bytes)?;
        self.push(Value::Opaque)
    }
}
