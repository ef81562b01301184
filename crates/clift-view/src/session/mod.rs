//! Browsers and their frames: what each waits for, and the thread that renders.
//!
//! - `frame_budget`: fewer tokens, lower quality and smaller frames for a time per frame
//! - `clients`: mailboxes of the browsers, and whose turn it is
//! - `render_loop`: the thread that owns the device

pub(crate) mod clients;
pub(crate) mod frame_budget;
pub(crate) mod render_loop;
