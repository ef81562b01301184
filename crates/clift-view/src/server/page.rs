//! The files of the page and their headers.

use axum::http::{HeaderName, HeaderValue, header};

/// Files by their path below `/`: content type and text.
const FILES: [(&str, &str, &str); 9] = [
    ("", "text/html; charset=utf-8", include_str!("../page/index.html")),
    ("style.css", "text/css; charset=utf-8", include_str!("../page/style.css")),
    ("viewer.js", SCRIPT, include_str!("../page/viewer.js")),
    ("connection.js", SCRIPT, include_str!("../page/connection.js")),
    ("camera.js", SCRIPT, include_str!("../page/camera.js")),
    ("controls.js", SCRIPT, include_str!("../page/controls.js")),
    ("drawing.js", SCRIPT, include_str!("../page/drawing.js")),
    ("path.js", SCRIPT, include_str!("../page/path.js")),
    ("icon.svg", "image/svg+xml", include_str!("../page/icon.svg")),
];
const SCRIPT: &str = "text/javascript; charset=utf-8";

/// Headers of every answer: no other origin is loaded, framed or told of, and nothing is stored.
pub const HEADERS: [(HeaderName, HeaderValue); 6] = [
    (
        header::CONTENT_SECURITY_POLICY,
        HeaderValue::from_static(
            "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; \
             base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
        ),
    ),
    (header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff")),
    (header::REFERRER_POLICY, HeaderValue::from_static("no-referrer")),
    (header::CACHE_CONTROL, HeaderValue::from_static("no-store")),
    (HeaderName::from_static("cross-origin-opener-policy"), HeaderValue::from_static("same-origin")),
    (HeaderName::from_static("cross-origin-resource-policy"), HeaderValue::from_static("same-origin")),
];

pub fn file(path: &str) -> Option<(&'static str, &'static str)> {
    let name = path.strip_prefix('/')?;
    FILES.iter().find(|(file, ..)| *file == name).map(|(_, kind, text)| (*kind, *text))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_has_no_inline_code_and_no_other_origin() {
        for (name, _, text) in FILES {
            let found =
                ["style=", " onclick", "https://", "eval(", "innerHTML"].into_iter().find(|part| text.contains(part));
            assert_eq!(found, None, "{name}");
        }
        let html = FILES[0].2;
        assert_eq!(html.matches("<script").count(), html.matches("<script type=\"module\" src=\"viewer.js\">").count());
        for (name, kind, _) in &FILES[1..] {
            let named = FILES.iter().any(|(_, _, text)| text.contains(name));
            assert!(named, "no file uses {name} ({kind})");
        }
    }
}
