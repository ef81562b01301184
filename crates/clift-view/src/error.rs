//! Errors of the viewer.

use std::net::SocketAddr;

/// Errors of this crate.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the message of a variant says what its fields are")]
pub enum ViewError {
    /// Address that cannot be listened on.
    #[error("cannot listen on {address}: {source}; choose another --port (0: any free port) or --listen")]
    Bind { address: SocketAddr, source: std::io::Error },
    /// Failure of the thread that serves HTTP.
    #[error("serving the page failed: {source}")]
    Serve { source: std::io::Error },
    /// A view was requested before a scene.
    #[error("no scene is open; open a scene first")]
    NoScene,
    /// A scene or frame beyond the offered ones.
    #[error("no {name} {value}; the {name}s are 0 to {last}")]
    OutOfRange { name: &'static str, value: usize, last: usize },
    /// Data could not be read or encoded.
    #[error(transparent)]
    Data(#[from] clift_data::DataError),
    /// A scene could not be encoded.
    #[error(transparent)]
    Scene(#[from] clift_scene::SceneError),
    /// An image could not be made.
    #[error(transparent)]
    Eval(#[from] clift_eval::EvalError),
    /// The model refused its input.
    #[error(transparent)]
    Model(#[from] clift_model::ModelError),
}
