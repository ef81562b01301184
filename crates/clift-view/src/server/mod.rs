//! HTTP and web sockets.
//!
//! - `access`: who may connect: token, cookie, Host and Origin
//! - `page`: the files of the page and their headers
//! - `socket`: one web socket
//! - `view_server`: the port, the connections, the two threads

pub(crate) mod access;
pub(crate) mod page;
pub(crate) mod socket;
pub(crate) mod view_server;
