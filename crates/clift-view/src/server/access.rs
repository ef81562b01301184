//! Who may connect.
//!
//! The URL of the page has a random token, which the first answer turns into a cookie of the same site. Every request needs
//! one of the two. The Host header must name an IP address or `localhost`: a page that rebinds the DNS name of its own
//! server to this address sends that name. There is one such header, and a request with an absolute URI names the same host: programs
//! in between could read another one. A WebSocket must come from this origin.

use std::net::{IpAddr, SocketAddr};

use axum::http::{HeaderMap, Uri, header};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// Host that is not an address of this machine.
    Host,
    /// WebSocket from another origin.
    Origin,
    /// Neither token nor cookie.
    Token,
}

impl Refusal {
    pub fn text(self) -> &'static str {
        match self {
            Self::Host => "clift view answers only to IP addresses and localhost; open the URL that it printed\n",
            Self::Origin => "clift view accepts connections of its own page only\n",
            Self::Token => "open the URL that `clift view` printed: it has the token of this session\n",
        }
    }
}

#[derive(Clone, Debug)]
pub struct Access {
    token: String,
    pub address: SocketAddr,
}

impl Access {
    /// Makes a token of 128 random bits for a server that listens on `address`.
    pub fn new(address: SocketAddr) -> Self {
        Self { token: hex::encode(rand::random::<[u8; 16]>()), address }
    }

    pub fn url(&self) -> String {
        format!("http://{}/?token={}", self.address, self.token)
    }

    /// Returns the cookie that replaces the token. Cookies of all ports share one store, so that the name has the port.
    pub fn cookie(&self) -> String {
        format!("{}={}; Path=/; HttpOnly; SameSite=Strict", self.cookie_name(), self.token)
    }

    fn cookie_name(&self) -> String {
        format!("clift-view-{}", self.address.port())
    }

    /// Checks a request; returns whether it has the token in its URL.
    pub fn check(&self, uri: &Uri, headers: &HeaderMap, is_socket: bool) -> Result<bool, Refusal> {
        let mut hosts = headers.get_all(header::HOST).iter();
        let (Some(host), None) = (hosts.next(), hosts.next()) else { return Err(Refusal::Host) };
        let host = host.to_str().map_err(|_| Refusal::Host)?;
        if !self.is_own_host(host) || uri.authority().is_some_and(|authority| authority.as_str() != host) {
            return Err(Refusal::Host);
        }
        let origin = headers.get(header::ORIGIN).map(|origin| origin.to_str().unwrap_or_default());
        let is_own_origin = |origin: &str| origin.strip_prefix("http://") == Some(host);
        if origin.map_or(is_socket, |origin| !is_own_origin(origin)) {
            return Err(Refusal::Origin);
        }
        let mut parameters = uri.query().unwrap_or_default().split('&');
        if parameters.any(|one| one.strip_prefix("token=").is_some_and(|token| self.is_token(token))) {
            return Ok(true);
        }
        let cookies = headers.get_all(header::COOKIE).iter().filter_map(|cookies| cookies.to_str().ok());
        let mut cookies = cookies.flat_map(|cookies| cookies.split(';')).filter_map(|one| one.trim().split_once('='));
        let name = self.cookie_name();
        let has_cookie = cookies.any(|(one, token)| one == name && self.is_token(token));
        if has_cookie { Ok(false) } else { Err(Refusal::Token) }
    }

    /// Compares in a time that does not depend on the position of the first difference.
    fn is_token(&self, token: &str) -> bool {
        let differences = token.bytes().zip(self.token.bytes()).fold(0, |sum, (a, b)| sum | (a ^ b));
        token.len() == self.token.len() && differences == 0
    }

    /// The port may be another one, at the near end of a tunnel.
    fn is_own_host(&self, host: &str) -> bool {
        let name = match host.rsplit_once(':') {
            Some((name, port)) if port.bytes().all(|byte| byte.is_ascii_digit()) && !port.is_empty() => name,
            _ => host,
        };
        if name.eq_ignore_ascii_case("localhost") {
            return true;
        }
        let address = name.strip_prefix('[').and_then(|name| name.strip_suffix(']')).unwrap_or(name);
        let is_reached = |ip: IpAddr| ip.is_loopback() || !self.address.ip().is_loopback();
        address.parse().is_ok_and(is_reached)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn access(address: &str) -> Access {
        Access { token: "0123456789abcdef".into(), address: address.parse().unwrap() }
    }

    fn check(access: &Access, uri: &str, headers: &[(&str, &str)], is_socket: bool) -> Result<bool, Refusal> {
        let mut map = HeaderMap::new();
        for (name, value) in headers {
            let name: header::HeaderName = name.parse().unwrap();
            map.append(name, value.parse().unwrap());
        }
        access.check(&uri.parse().unwrap(), &map, is_socket)
    }

    #[test]
    fn token_becomes_a_cookie() {
        let access = access("127.0.0.1:4000");
        let host = ("host", "127.0.0.1:4000");
        assert_eq!(check(&access, "/?token=0123456789abcdef", &[host], false), Ok(true));
        let cookie = access.cookie();
        let cookie = ("cookie", cookie.split(';').next().unwrap());
        assert_eq!(check(&access, "/page.js", &[host, ("cookie", "a=b; c"), cookie], false), Ok(false));
        for (uri, headers) in [
            ("/", vec![host]),
            ("/?token=", vec![host]),
            ("/?token=0123456789abcdee", vec![host]),
            ("/?token=0123456789abcdef0", vec![host]),
            ("/", vec![host, ("cookie", "clift-view-4001=0123456789abcdef")]),
            ("/", vec![host, ("cookie", "clift-view-4000=")]),
        ] {
            assert_eq!(check(&access, uri, &headers, false), Err(Refusal::Token), "{uri} {headers:?}");
        }
        assert_ne!(Access::new(access.address).token, Access::new(access.address).token);
    }

    #[test]
    fn hosts_are_addresses_of_this_machine() {
        let host = |access: &Access, host: &str| check(access, "/?token=0123456789abcdef", &[("host", host)], false);
        let loopback = access("127.0.0.1:4000");
        for one in ["127.0.0.1:4000", "localhost:4000", "localhost:8080", "LOCALHOST", "[::1]:4000", "127.0.0.1"] {
            assert_eq!(host(&loopback, one), Ok(true), "{one}");
        }
        for one in ["evil.example:4000", "evil.example", "192.168.0.7:4000", "127.0.0.1.evil.example", "", ":4000"] {
            assert_eq!(host(&loopback, one), Err(Refusal::Host), "{one}");
        }
        let open = access("0.0.0.0:4000");
        assert_eq!(host(&open, "192.168.0.7:4000"), Ok(true));
        assert_eq!(host(&open, "evil.example:4000"), Err(Refusal::Host));
        assert_eq!(check(&open, "/", &[], false), Err(Refusal::Host));
        let own = ("host", "localhost:4000");
        for (uri, headers, refused) in [
            ("/", [own, own].as_slice(), true),
            ("/", &[own, ("host", "evil.example")], true),
            ("http://evil.example/", &[own], true),
            ("http://localhost:4000/", &[own], false),
        ] {
            let is_refused = check(&loopback, uri, headers, false) == Err(Refusal::Host);
            assert_eq!(is_refused, refused, "{uri} {headers:?}");
        }
    }

    #[test]
    fn sockets_come_from_the_own_origin() {
        let access = access("127.0.0.1:4000");
        let uri = "/socket?token=0123456789abcdef";
        let host = ("host", "localhost:4000");
        let from = |origin| check(&access, uri, &[host, ("origin", origin)], true);
        assert_eq!(from("http://localhost:4000"), Ok(true));
        for origin in ["http://evil.example", "http://localhost:4001", "https://localhost:4000", "null", ""] {
            assert_eq!(from(origin), Err(Refusal::Origin), "{origin}");
        }
        assert_eq!(check(&access, uri, &[host], true), Err(Refusal::Origin));
        assert_eq!(check(&access, uri, &[host], false), Ok(true), "pages are opened without an origin");
    }
}
