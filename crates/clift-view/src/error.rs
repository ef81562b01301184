//! Errors of the viewer.

use std::net::SocketAddr;

/// Errors of this crate.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the message of a variant says what its fields are")]
pub enum ViewError {
    #[error("cannot listen on {address}: {source}; choose another --port (0: any free port) or --listen")]
    Bind { address: SocketAddr, source: std::io::Error },
    #[error("serving the page failed: {source}")]
    Serve { source: std::io::Error },
    #[error("no scene is open; open a scene first")]
    NoScene,
    #[error("no {name} {value}; the {name}s are 0 to {last}")]
    OutOfRange { name: &'static str, value: usize, last: usize },
    #[error(transparent)]
    Data(#[from] clift_data::DataError),
    #[error(transparent)]
    Scene(#[from] clift_scene::SceneError),
    #[error(transparent)]
    Eval(#[from] clift_eval::EvalError),
    #[error(transparent)]
    Model(#[from] clift_model::ModelError),
}
