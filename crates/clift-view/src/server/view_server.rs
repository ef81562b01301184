//! The port, the connections and the two threads: the caller's renders, a second one serves.

use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::body::Bytes;
use axum::extract::ws::WebSocketUpgrade;
use axum::extract::{Request, State};
use axum::http::{HeaderValue, StatusCode, header};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use clift_model::{DeviceName, Precision, SelectionPreset};
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use serde_json::json;
use tokio::sync::Semaphore;

use crate::error::ViewError;
use crate::protocol::reply::message;
use crate::protocol::request::MAX_REQUEST_BYTES;
use crate::scenes::scene_set::SceneSet;
use crate::server::access::Access;
use crate::server::{page, socket};
use crate::session::clients::Clients;
use crate::session::render_loop::RenderLoop;

/// Most connections at a time; further ones are closed.
const MAX_CONNECTIONS: usize = 256;
/// Longest time for the head of a request.
const HEAD_TIMEOUT: Duration = Duration::from_secs(5);
/// Bytes of a connection's read buffer: the head of a request must fit.
const MAX_HEAD_BYTES: usize = 16 << 10;
const SOCKET_PATH: &str = "/socket";

/// A server with its port and token.
#[derive(Debug)]
pub struct ViewServer {
    listener: TcpListener,
    access: Access,
}

/// State shared by all requests.
struct Shared {
    access: Access,
    clients: Arc<Clients>,
    hello: Bytes,
}

impl ViewServer {
    /// Takes the port of the address; 0 takes a free port.
    pub fn bind(address: SocketAddr) -> Result<Self, ViewError> {
        let bind = || {
            let listener = TcpListener::bind(address)?;
            listener.set_nonblocking(true)?;
            Ok((listener.local_addr()?, listener))
        };
        let (address, listener) = bind().map_err(|source| ViewError::Bind { address, source })?;
        Ok(Self { listener, access: Access::new(address) })
    }

    /// Returns the address with the port.
    pub fn address(&self) -> SocketAddr {
        self.access.address
    }

    /// Returns the URL of the page, with the token.
    pub fn url(&self) -> String {
        self.access.url()
    }

    /// Renders and serves until serving fails.
    pub fn run(self, scenes: SceneSet, device_name: DeviceName) -> Result<(), ViewError> {
        let device = device_name.open()?;
        let selections: Vec<&str> = SelectionPreset::ALL.iter().map(|preset| preset.name()).collect();
        let precisions = Precision::ALL.into_iter().filter(|one| one.check("precision", &device).is_ok());
        let hello = json!({
            "scenes": scenes.keys(),
            "device": device_name.to_string(),
            "selections": selections,
            "default_selection": SelectionPreset::default().name(),
            "precisions": precisions.map(Precision::as_str).collect::<Vec<_>>(),
            "default_precision": Precision::for_images(&device).as_str(),
            "version": env!("CARGO_PKG_VERSION"),
        });
        let clients = Arc::new(Clients::default());
        let hello = message("hello", hello, &[]).into();
        let shared = Arc::new(Shared { access: self.access, clients: clients.clone(), hello });
        let serving = std::thread::spawn(move || {
            let clients = shared.clients.clone();
            let result = serve(self.listener, shared);
            clients.close();
            result
        });
        RenderLoop::new(scenes, device).run(&clients);
        let served = serving.join().unwrap_or_else(|_| Err(std::io::Error::other("the thread panicked")));
        served.map_err(|source| ViewError::Serve { source })
    }
}

/// Serves connections on this thread.
fn serve(listener: TcpListener, shared: Arc<Shared>) -> std::io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(async {
        let listener = tokio::net::TcpListener::from_std(listener)?;
        let routes = Router::new()
            .route(SOCKET_PATH, get(open_socket))
            .fallback(get(file))
            .layer(from_fn_with_state(shared.clone(), check))
            .with_state(shared);
        let service = TowerToHyperService::new(routes);
        let connections = Arc::new(Semaphore::new(MAX_CONNECTIONS));
        loop {
            let Ok((stream, _)) = listener.accept().await else {
                // Too many open files, or a connection that is gone already.
                tokio::time::sleep(Duration::from_millis(100)).await;
                continue;
            };
            let Ok(permit) = connections.clone().try_acquire_owned() else { continue };
            drop(stream.set_nodelay(true));
            let service = service.clone();
            tokio::spawn(async move {
                let mut http = http1::Builder::new();
                http.timer(TokioTimer::new()).header_read_timeout(HEAD_TIMEOUT).max_buf_size(MAX_HEAD_BYTES);
                let connection = http.serve_connection(TokioIo::new(stream), service).with_upgrades();
                // A connection that breaks is not an error of the server.
                drop(connection.await);
                drop(permit);
            });
        }
    })
}

/// Refuses requests without access, and adds the headers of all answers.
async fn check(State(shared): State<Arc<Shared>>, request: Request, next: Next) -> Response {
    let is_socket = request.uri().path() == SOCKET_PATH;
    let mut response = match shared.access.check(request.uri(), request.headers(), is_socket) {
        Ok(has_token) => {
            let mut response = next.run(request).await;
            if has_token && let Ok(cookie) = HeaderValue::from_str(&shared.access.cookie()) {
                response.headers_mut().insert(header::SET_COOKIE, cookie);
            }
            response
        }
        Err(refusal) => (StatusCode::FORBIDDEN, refusal.text()).into_response(),
    };
    response.headers_mut().extend(page::HEADERS);
    response
}

async fn file(request: Request) -> Response {
    match page::file(request.uri().path()) {
        Some((kind, text)) => ([(header::CONTENT_TYPE, kind)], text).into_response(),
        None => (StatusCode::NOT_FOUND, "no such file\n").into_response(),
    }
}

async fn open_socket(State(shared): State<Arc<Shared>>, upgrade: WebSocketUpgrade) -> Response {
    let upgrade = upgrade.max_message_size(MAX_REQUEST_BYTES).max_frame_size(MAX_REQUEST_BYTES);
    upgrade.on_upgrade(move |stream| socket::serve(stream, shared.clients.clone(), shared.hello.clone()))
}
