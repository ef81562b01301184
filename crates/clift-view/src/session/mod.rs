//! Browsers and their frames: what each waits for, and the thread that renders.
//!
//! - `frame_budget`: fewer tokens and smaller frames for a time per frame
//! - `clients`: mailboxes of the browsers, served in turn
//! - `render_loop`: the thread that owns the device

pub(crate) mod clients;
pub(crate) mod frame_budget;
pub(crate) mod render_loop;
