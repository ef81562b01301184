//! `clift view`: the page in a browser, its sockets, the order of frames, hostile clients.

mod browser;
mod chromium;
mod frames;
mod hostile;
pub mod tab;
