//! A scene in a browser: the server and the page of `clift view`.
//!
//! [`ViewServer`] binds a port, then renders for the browsers that open its URL. The thread that calls
//! [`ViewServer::run`] owns the device and renders; a second thread serves HTTP and web sockets.
//!
//! ```no_run
//! use clift_model::DeviceName;
//! use clift_scene::{Scene, load_renderer};
//! use clift_view::{SceneFile, SceneSet, ViewServer};
//!
//! let device = DeviceName::Flex.open()?;
//! let (scene, coding) = Scene::read("room.clift".as_ref())?;
//! let file_bytes = std::fs::metadata("room.clift")?.len();
//! let renderer = load_renderer(&scene, "runs/tiny/stage2/model.safetensors".as_ref(), &device)?;
//! let render_args = vec!["room.clift".into()];
//! let scenes = SceneSet::File(Box::new(SceneFile { scene, coding, file_bytes, renderer, render_args }));
//! let server = ViewServer::bind("127.0.0.1:0".parse()?)?;
//! println!("{}", server.url());
//! server.run(scenes, DeviceName::Flex)?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod error;
mod protocol;
mod scenes;
mod server;
mod session;

pub use error::ViewError;
pub use scenes::scene_set::{RunScenes, SceneFile, SceneSet};
pub use server::view_server::ViewServer;
