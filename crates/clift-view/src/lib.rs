//! A scene in a browser: the server and the page of `clift view`.
//!
//! [`ViewServer`] binds a port, then renders for the browsers that open its URL. The thread that calls
//! [`ViewServer::run`] owns the device and renders; a second thread serves HTTP and web sockets.

mod error;
mod protocol;
mod scenes;
mod server;
mod session;

pub use error::ViewError;
pub use scenes::scene_set::{RunScenes, SceneFile, SceneSet};
pub use server::view_server::ViewServer;
