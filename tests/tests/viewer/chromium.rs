//! Headless Chromium, driven through its debugging socket.

use std::io::{BufRead, BufReader};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, ChildStderr, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use tungstenite::client::IntoClientRequest;
use tungstenite::{Message, WebSocket};

/// Programs that are tried, on the PATH.
const PROGRAMS: [&str; 4] = ["chromium", "chromium-browser", "google-chrome", "google-chrome-stable"];

/// A browser with one page.
pub struct Chromium {
    child: Child,
    socket: WebSocket<TcpStream>,
    session: Value,
    next_id: u64,
    /// Exceptions and errors that the page reported.
    pub problems: Vec<String>,
    _stderr: BufReader<ChildStderr>,
}

impl Chromium {
    /// Starts a browser with its profile and downloads in `folder`; `None` where there is none.
    pub fn start(folder: &Path) -> Option<Self> {
        let profile = folder.join("profile");
        let profile = format!("--user-data-dir={}", profile.display());
        let start = |program: &&str| {
            Command::new(program)
                // Tests run as root in containers, where the sandbox does not start.
                .args(["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"])
                .args(["--no-first-run", "--remote-debugging-port=0", &profile, "about:blank"])
                .stdin(Stdio::null())
                .stdout(Stdio::null())
                .stderr(Stdio::piped())
                .spawn()
                .ok()
        };
        let mut child = PROGRAMS.iter().find_map(start)?;
        let mut stderr = BufReader::new(child.stderr.take().expect("piped"));
        let mut line = String::new();
        let url = loop {
            line.clear();
            assert!(stderr.read_line(&mut line).expect("text") > 0, "the browser ended");
            if let Some((_, url)) = line.split_once("DevTools listening on ") {
                break url.trim().to_owned();
            }
        };
        let host = url.trim_start_matches("ws://").split('/').next().expect("a host");
        let stream = TcpStream::connect(host).expect("the browser listens");
        stream.set_read_timeout(Some(Duration::from_mins(1))).expect("a socket");
        let (socket, _) = tungstenite::client(url.into_client_request().expect("a URL"), stream).expect("DevTools");
        let (session, problems) = (Value::Null, Vec::new());
        let mut browser = Self { child, socket, session, next_id: 0, problems, _stderr: stderr };
        let target = browser.call("Target.createTarget", json!({"url": "about:blank"}))["targetId"].clone();
        let attached = browser.call("Target.attachToTarget", json!({"targetId": target, "flatten": true}));
        browser.session = attached["sessionId"].clone();
        for domain in ["Page", "Runtime", "Log"] {
            browser.call(&format!("{domain}.enable"), json!({}));
        }
        let downloads = json!({"behavior": "allow", "downloadPath": folder.display().to_string()});
        browser.call("Browser.setDownloadBehavior", downloads);
        let size = json!({"width": 1200, "height": 800, "deviceScaleFactor": 1, "mobile": false});
        browser.call("Emulation.setDeviceMetricsOverride", size);
        Some(browser)
    }

    /// Calls a method and returns its result.
    fn call(&mut self, method: &str, params: Value) -> Value {
        self.try_call(method, params).unwrap_or_else(|error| panic!("{method}: {error}"))
    }

    fn try_call(&mut self, method: &str, params: Value) -> Result<Value, Value> {
        self.next_id += 1;
        let mut message = json!({"id": self.next_id, "method": method, "params": params});
        if !self.session.is_null() {
            message["sessionId"] = self.session.clone();
        }
        self.socket.send(Message::text(message.to_string())).expect("DevTools is open");
        loop {
            let text = self.socket.read().expect("an answer within a minute").into_text().expect("text");
            let mut answer: Value = serde_json::from_str(&text).expect("JSON");
            if answer["id"] == self.next_id {
                let error = answer["error"].take();
                return if error.is_null() { Ok(answer["result"].take()) } else { Err(error) };
            }
            // An event of the page.
            let params = &answer["params"];
            match answer["method"].as_str() {
                Some("Runtime.exceptionThrown") => self.problems.push(params["exceptionDetails"].to_string()),
                Some("Log.entryAdded") if params["entry"]["level"] == "error" => {
                    self.problems.push(params["entry"]["text"].to_string());
                }
                _ => {}
            }
        }
    }

    /// Evaluates an expression, or awaits a promise.
    pub fn evaluate(&mut self, expression: &str) -> Value {
        let params = json!({"expression": expression, "awaitPromise": true, "returnByValue": true});
        let mut result = self.call("Runtime.evaluate", params);
        assert!(result["exceptionDetails"].is_null(), "{expression}: {}", result["exceptionDetails"]);
        result["result"]["value"].take()
    }

    /// Waits until an expression is true; while a page loads, there may be nothing to evaluate it.
    #[track_caller]
    pub fn wait_for(&mut self, expression: &str) {
        let started = Instant::now();
        let params = json!({"expression": expression, "returnByValue": true});
        let is_true = |result: Value| result["result"]["value"] == true;
        while !self.try_call("Runtime.evaluate", params.clone()).is_ok_and(is_true) {
            assert!(started.elapsed() < Duration::from_mins(1), "{expression} is not true within a minute");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    pub fn open(&mut self, url: &str) {
        // The page before is still there for a moment.
        self.evaluate("delete document.documentElement.dataset.picture");
        self.call("Page.navigate", json!({"url": url}));
    }

    /// Drags the mouse between two points in CSS pixels.
    pub fn drag(&mut self, from: [f64; 2], to: [f64; 2]) {
        let mut mouse = |kind: &str, [x, y]: [f64; 2], buttons: u32| {
            let params = json!({"type": kind, "x": x, "y": y, "button": "left", "buttons": buttons, "clickCount": 1});
            self.call("Input.dispatchMouseEvent", params);
        };
        mouse("mousePressed", from, 1);
        for i in 1..=10 {
            let at = f64::from(i) / 10.0;
            mouse("mouseMoved", [0, 1].map(|axis| from[axis] + at * (to[axis] - from[axis])), 1);
        }
        mouse("mouseReleased", to, 0);
    }
}

impl Drop for Chromium {
    fn drop(&mut self) {
        drop(self.child.kill());
        drop(self.child.wait());
    }
}
