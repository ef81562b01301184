//! A value of a configuration that is out of range, or contradicts another value.

/// A wrong value of a configuration.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{key}` = {value}: {fix}")]
pub struct BadConfig {
    /// Dotted key, as in the TOML file, or several with commas between them.
    pub key: String,
    /// The value found, or `missing`.
    pub value: String,
    /// The remedy. Other keys of the cause stand in it as dotted keys.
    pub fix: String,
}

impl BadConfig {
    /// Creates the error of a key.
    pub fn new(key: impl Into<String>, value: impl ToString, fix: impl Into<String>) -> Self {
        Self { key: key.into(), value: value.to_string(), fix: fix.into() }
    }

    /// Adds the section of the key.
    #[must_use]
    pub fn in_section(mut self, section: &str) -> Self {
        self.key = format!("{section}.{}", self.key);
        self
    }
}

/// Returns a [`BadConfig`] unless the value of `key` is valid.
pub fn check_config(
    is_valid: bool,
    key: &str,
    value: impl ToString,
    fix: impl FnOnce() -> String,
) -> Result<(), BadConfig> {
    if is_valid { Ok(()) } else { Err(BadConfig::new(key, value, fix())) }
}
