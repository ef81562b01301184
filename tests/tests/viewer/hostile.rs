//! Clients that send what no page sends.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tungstenite::Message;

use crate::support::{Place, WHOLE};
use crate::viewer::tab::{Tab, Viewer};

/// Sends a request and returns the head and body of the answer.
fn http(viewer: &Viewer, path: &str, headers: &str) -> String {
    let mut stream = TcpStream::connect(&viewer.host).expect("it listens");
    stream.set_read_timeout(Some(Duration::from_secs(20))).expect("a socket");
    write!(stream, "GET {path} HTTP/1.1\r\nConnection: close\r\n{headers}\r\n").expect("it reads");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).expect("text");
    answer
}

#[test]
fn only_the_url_with_its_token_opens_the_page() {
    let place = Place::with(&WHOLE);
    let viewer = Viewer::start(&["run"], &place.at(""));
    let Viewer { host, token, .. } = &viewer;
    let own = format!("Host: {host}\r\n");
    let page = http(&viewer, &format!("/?token={token}"), &own);
    assert!(page.starts_with("HTTP/1.1 200") && page.contains("<title>clift view</title>"), "{page}");
    let head = page.split("\r\n\r\n").next().expect("a head").to_lowercase();
    for part in
        ["samesite=strict", "httponly", "default-src 'none'", "frame-ancestors 'none'", "nosniff", "no-referrer"]
    {
        assert!(head.contains(part), "{part} is not in {head}");
    }
    let cookie = head.lines().find_map(|line| line.strip_prefix("set-cookie: ")).expect("a cookie");
    let cookie = format!("{own}Cookie: {}\r\n", cookie.split(';').next().expect("a value"));
    assert!(http(&viewer, "/viewer.js", &cookie).starts_with("HTTP/1.1 200"));
    // `server/access.rs` tests which tokens, hosts and origins are refused; here that requests and sockets are checked.
    for (path, headers, status) in [
        ("/", &own, 403),
        ("/viewer.js", &own, 403),
        ("/", &cookie.replace(host.as_str(), "evil.example"), 403),
        ("/viewer.js", &format!("{cookie}Origin: http://evil.example\r\n"), 403),
        ("/../../etc/passwd", &cookie, 404),
    ] {
        let answer = http(&viewer, path, headers);
        assert!(answer.starts_with(&format!("HTTP/1.1 {status}")), "{path} {headers}: {answer}");
    }
    let origin = format!("http://{host}");
    assert!(viewer.socket(host, &origin, token).is_some());
    assert!(viewer.socket(host, &origin, "0123").is_none());
    assert!(viewer.socket(host, "http://evil.example", token).is_none());
}

#[test]
fn hostile_clients_take_neither_memory_nor_frames() {
    let place = Place::with(&WHOLE);
    let mut viewer = Viewer::start(&["run"], &place.at(""));
    let mut tab = Tab::open(&viewer);
    drop(tab.picture(1));
    let peak_before = viewer.peak_bytes();
    let origin = format!("http://{}", viewer.host);
    std::thread::scope(|scope| {
        let viewer = &viewer;
        let attack = scope.spawn(move || {
            // Connections that say nothing, half a request, or another protocol.
            let idle: Vec<_> = (0..100)
                .filter_map(|i| {
                    let mut stream = TcpStream::connect(&viewer.host).ok()?;
                    let start = ["", "GET / HT", "\x16\x03\x01\x02\x00\x01", "PRI * HTTP/2.0\r\n\r\n"][i % 4];
                    drop(stream.write_all(start.as_bytes()));
                    Some(stream)
                })
                .collect();
            let mut random = ChaCha8Rng::seed_from_u64(7);
            for round in 0..20 {
                let Some(mut socket) = viewer.socket(&viewer.host, &format!("http://{}", viewer.host), &viewer.token)
                else {
                    continue;
                };
                for _ in 0..50 {
                    if socket.send(message(&mut random, round)).is_err() {
                        break;
                    }
                    std::thread::sleep(Duration::from_millis(1));
                }
            }
            drop(idle);
        });
        // Every camera of the page gets its picture.
        while !attack.is_finished() {
            drop(tab.picture(1));
        }
    });
    let grown = viewer.peak_bytes() - peak_before;
    assert!(grown < 64 << 20, "{grown} bytes more");
    assert!(viewer.child.try_wait().expect("a child").is_none(), "the viewer runs");
    // More tabs than are served: they are told so, the first one goes on.
    let sockets: Vec<_> = (0..100).filter_map(|_| viewer.socket(&viewer.host, &origin, &viewer.token)).collect();
    assert!(sockets.len() > 15);
    drop(tab.picture(1));
    drop(sockets);
}

/// A message of one of many wrong forms.
fn message(random: &mut ChaCha8Rng, round: usize) -> Message {
    let view = |c2w: &str, tokens: &str, size: &str| {
        format!(
            r#"{{"type":"view","seq":{round},"c2w":{c2w},"intrinsics":[1,1,0.5,0.5],"tokens":{tokens},"selection":"paper",
            "precision":"f32","size":{size},"budget_ms":0.001,"rest":false,"list_tokens":true}}"#
        )
    };
    let unit = "[1,0,0,0,0,1,0,0,0,0,1,0]";
    let text = match random.random_range(0..12) {
        0 => return Message::binary((0..random.random_range(0..300)).map(|_| random.random()).collect::<Vec<u8>>()),
        1 => "x".repeat(random.random_range(0..100_000)),
        2 => view(unit, "18446744073709551615", "18446744073709551615"),
        3 => view("[1e308,0,0,0,0,1e308,0,0,0,0,1e308,0]", "4", "0"),
        4 => view(unit, "-4", "0"),
        5 => format!(r#"{{"type":"ack","seq":{}}}"#, random.random::<u64>()),
        6 => r#"{"type":"open","scene":4000000000,"stored":1}"#.into(),
        7 => format!(r#"{{"type":"open","scene":{},"stored":{}}}"#, round % 3, random.random_range(0..99)),
        8 => r#"{"type":"compare","frame":99999,"tokens":0,"selection":"paper","precision":"f32","image":true}"#.into(),
        9 => r#"{"type":"compare","frame":0,"tokens":0,"selection":"paper","precision":"f32","image":true}"#.into(),
        10 => "[".repeat(4000),
        _ => return Message::Ping(vec![0; 100].into()),
    };
    Message::text(text)
}
