//! Messages between page and server.
//!
//! - `request`: messages of the page, JSON text
//! - `reply`: messages of the server, binary: a JSON header and images

pub(crate) mod reply;
pub(crate) mod request;
