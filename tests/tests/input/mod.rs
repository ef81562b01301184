//! Wrong, damaged and hostile input.
//!
//! `error_messages` compares whole messages with `tests/snapshots`; `bad_input` checks what a run does with damaged data,
//! checkpoints and weights; `attack` damages the files of every reader at random.

mod attack;
mod bad_input;
mod error_messages;
