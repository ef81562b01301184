//! HTTP and web sockets.
//!
//! - `access`: who may connect: token, cookie, Host and Origin
//! - `page`: the files of the page and their headers
//! - `rate_limit`: messages per second of a socket
//! - `socket`: one web socket
//! - `view_server`: the port, the connections, the two threads

pub(crate) mod access;
pub(crate) mod page;
pub(crate) mod rate_limit;
pub(crate) mod socket;
pub(crate) mod view_server;
