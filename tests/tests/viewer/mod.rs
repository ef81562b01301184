//! `clift view`: the page in a browser, its sockets, hostile clients, latency.

mod browser;
mod chromium;
mod hostile;
mod latency;
pub mod tab;
