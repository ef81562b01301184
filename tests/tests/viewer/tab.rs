//! A running viewer, and one tab of it without a browser.

use std::io::{BufRead, BufReader};
use std::net::TcpStream;
use std::process::{Child, ChildStdout, Command, Stdio};
use std::time::Duration;

use serde_json::{Value, json};
use tungstenite::client::IntoClientRequest;
use tungstenite::{Message, WebSocket};

use crate::support::BINARY;

/// A viewer that ends with this value.
pub struct Viewer {
    pub child: Child,
    pub url: String,
    /// `127.0.0.1:port`.
    pub host: String,
    pub token: String,
    _stdout: BufReader<ChildStdout>,
}

impl Viewer {
    /// Starts `clift view` with these words in a folder, by default on a free port and without a browser.
    pub fn start(words: &[&str], folder: &std::path::Path) -> Self {
        let mut command = Command::new(BINARY);
        command.arg("view").args(words).current_dir(folder).env("XDG_DATA_HOME", env!("CARGO_TARGET_TMPDIR"));
        if !words.contains(&"--no-open") {
            command.arg("--no-open");
        }
        let mut child =
            command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::inherit()).spawn().expect("it starts");
        let mut stdout = BufReader::new(child.stdout.take().expect("piped"));
        let mut url = String::new();
        stdout.read_line(&mut url).expect("the first line is the URL");
        let url = url.trim().to_owned();
        let (host, token) = url.strip_prefix("http://").and_then(|rest| rest.split_once("/?token=")).expect(&url);
        let (host, token) = (host.to_owned(), token.to_owned());
        Self { child, url, host, token, _stdout: stdout }
    }

    /// Opens a socket with the headers of a request; `None` where the server refuses it.
    pub fn socket(&self, host: &str, origin: &str, token: &str) -> Option<WebSocket<TcpStream>> {
        let stream = TcpStream::connect(&self.host).expect("it listens");
        stream.set_nodelay(true).expect("a socket");
        stream.set_read_timeout(Some(Duration::from_secs(20))).expect("a socket");
        let mut request = format!("ws://{}/socket?token={token}", self.host).into_client_request().expect("a URL");
        for (name, value) in [("host", host), ("origin", origin)] {
            request.headers_mut().insert(name, value.parse().expect("a header"));
        }
        tungstenite::client(request, stream).ok().map(|(socket, _)| socket)
    }

    /// CPU seconds of the process.
    pub fn cpu_s(&self) -> f64 {
        let stat = std::fs::read_to_string(format!("/proc/{}/stat", self.child.id())).expect("Linux");
        let fields: Vec<&str> = stat.rsplit_once(") ").expect("a name").1.split(' ').collect();
        let ticks: f64 = [11, 12].map(|i| fields[i].parse::<f64>().expect("a number")).iter().sum();
        ticks / 100.0
    }

    /// Largest resident memory so far, in bytes.
    pub fn peak_bytes(&self) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).expect("Linux");
        let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).expect("a peak");
        1024 * line.trim().trim_end_matches(" kB").parse::<u64>().expect("a number")
    }
}

impl Drop for Viewer {
    fn drop(&mut self) {
        drop(self.child.kill());
        drop(self.child.wait());
    }
}

/// A tab: an open scene, and a camera that moves.
pub struct Tab {
    socket: WebSocket<TcpStream>,
    pub scene: Value,
    seq: u64,
}

impl Tab {
    pub fn open(viewer: &Viewer) -> Self {
        let origin = format!("http://{}", viewer.host);
        let socket = viewer.socket(&viewer.host, &origin, &viewer.token).expect("the page's own request is accepted");
        let mut tab = Self { socket, scene: Value::Null, seq: 0 };
        assert_eq!(tab.reply()["type"], "hello");
        tab.send(&json!({"type": "open", "scene": 0, "stored": null}));
        tab.scene = tab.reply();
        assert_eq!(tab.scene["type"], "scene", "{}", tab.scene);
        tab
    }

    pub fn send(&mut self, message: &Value) {
        self.socket.send(Message::text(message.to_string())).expect("the socket is open");
    }

    /// Receives the header of a reply.
    pub fn reply(&mut self) -> Value {
        let message = self.socket.read().expect("a reply within the time limit").into_data();
        let (length, rest) = message.split_first_chunk::<4>().expect("a length");
        serde_json::from_slice(&rest[..u32::from_le_bytes(*length) as usize]).expect("JSON")
    }

    pub fn send_view(&mut self, tokens: u64) {
        self.seq += 1;
        let context = &self.scene["context"][0];
        let mut c2w: Vec<f64> = context["c2w"].as_array().expect("rows").iter().filter_map(Value::as_f64).collect();
        c2w[3] += 0.001 * (self.seq % 100) as f64;
        let view = json!({
            "type": "view", "seq": self.seq, "c2w": c2w, "intrinsics": context["intrinsics"], "tokens": tokens,
            "selection": "scaled", "precision": "f32", "size": 0, "budget_ms": null,
            "rest": false, "list_tokens": false,
        });
        self.send(&view);
    }

    /// Moves the camera, waits for its picture, and returns the header of that.
    pub fn picture(&mut self, tokens: u64) -> Value {
        self.send_view(tokens);
        let header = self.reply();
        assert_eq!((&header["type"], &header["seq"]), (&"frame".into(), &self.seq.into()), "{header}");
        self.send(&json!({"type": "ack", "seq": self.seq}));
        header
    }
}
