//! Text and pictures as HTML holds them.

use std::fmt::{self, Display, Write};

use crate::picture::Picture;

/// Text that comes from data: shown as it is, never read as markup, in content and in quoted attributes.
#[derive(Clone, Copy, Debug)]
pub struct Escaped<T>(pub T);

impl<T: Display> Display for Escaped<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(Escape(f), "{}", self.0)
    }
}

/// Escapes what is written to it.
struct Escape<'a, 'b>(&'a mut fmt::Formatter<'b>);

impl Write for Escape<'_, '_> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        for c in text.chars() {
            match c {
                '&' => self.0.write_str("&amp;"),
                '<' => self.0.write_str("&lt;"),
                '>' => self.0.write_str("&gt;"),
                '"' => self.0.write_str("&quot;"),
                '\'' => self.0.write_str("&#39;"),
                // HTML has no way to write these.
                c if c.is_control() && !matches!(c, '\n' | '\t') => self.0.write_char('\u{fffd}'),
                c => self.0.write_char(c),
            }?;
        }
        Ok(())
    }
}

/// A picture as the address of itself, for `src` and `href`.
///
/// # Errors
/// As [`Picture::png`].
pub fn data_uri(picture: &Picture) -> std::io::Result<String> {
    Ok(format!("data:image/png;base64,{}", base64(&picture.png()?)))
}

/// RFC 4648, with padding.
fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for chunk in bytes.chunks(3) {
        let byte = |i: usize| u32::from(chunk.get(i).copied().unwrap_or_default());
        let bits = byte(0) << 16 | byte(1) << 8 | byte(2);
        for i in 0..4 {
            let digit = DIGITS[(bits >> (18 - 6 * i)) as usize & 63];
            text.push(if i <= chunk.len() { char::from(digit) } else { '=' });
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_text_from_data_becomes_markup() {
        let text = "a \"room\" <script>alert('x')</script> & more\u{7}\nnext";
        let expected = "a &quot;room&quot; &lt;script&gt;alert(&#39;x&#39;)&lt;/script&gt; &amp; more\u{fffd}\nnext";
        assert_eq!(Escaped(text).to_string(), expected);
        assert_eq!(Escaped(format_args!("{}{}", '<', 3)).to_string(), "&lt;3");
    }

    #[test]
    fn base64_is_that_of_the_rfc() {
        let cases = [
            ("", ""),
            ("f", "Zg=="),
            ("fo", "Zm8="),
            ("foo", "Zm9v"),
            ("foob", "Zm9vYg=="),
            ("fooba", "Zm9vYmE="),
            ("foobar", "Zm9vYmFy"),
        ];
        for (bytes, text) in cases {
            assert_eq!(base64(bytes.as_bytes()), text);
        }
        assert_eq!(base64(&[0xfb, 0xff, 0xbf]), "+/+/");
    }

    #[test]
    fn a_picture_is_a_png_in_its_address() {
        let uri = data_uri(&Picture::new(3, 2, [1, 2, 3])).unwrap();
        // The first six bytes of every PNG file are whole groups of three.
        assert!(uri.starts_with("data:image/png;base64,iVBORw0K"), "{uri}");
    }
}
