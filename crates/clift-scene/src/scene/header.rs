//! The metadata of a scene file's header, and why a file is refused.

use std::collections::HashMap;

pub(crate) struct Refusal {
    pub reason: String,
    pub fix: &'static str,
}

impl From<String> for Refusal {
    fn from(reason: String) -> Self {
        Self { reason, fix: "encode the scene again" }
    }
}

pub(crate) fn refusal(reason: impl Into<String>, fix: &'static str) -> Refusal {
    Refusal { reason: reason.into(), fix }
}

pub(crate) const COPY_AGAIN: &str = "copy it again, or encode the scene again";
pub(crate) const GIVE_MODEL: &str = "give the run it was encoded with (--model RUN)";

pub(crate) struct Fields(pub HashMap<String, String>);

impl Fields {
    pub fn get(&self, name: &str) -> Result<&str, String> {
        self.0.get(name).map(String::as_str).ok_or_else(|| format!("no `{name}` in the header"))
    }

    pub fn count(&self, name: &str) -> Result<usize, String> {
        let value = self.get(name)?;
        value.parse().map_err(|_| format!("{name} {value:?}, expected a number"))
    }

    /// Returns number, height and width of the context views of a coded file.
    pub fn views(&self) -> Result<[usize; 3], String> {
        let value = self.get("views")?;
        let sizes: Result<Vec<usize>, _> = value.split('x').map(str::parse).collect();
        let sizes = sizes.ok().and_then(|sizes| sizes.try_into().ok());
        sizes.ok_or_else(|| format!("views {value:?}, expected number x height x width, as \"4x64x64\""))
    }
}

/// Returns a header up to the first tensor. Equal scenes must be equal files, and the safetensors crate writes metadata in
/// random order.
pub(crate) fn write_fields(fields: &[(&str, &str)]) -> String {
    let field = |(name, value): &(&str, &str)| format!("\"{name}\":{}", serde_json::Value::from(*value));
    let fields: Vec<String> = fields.iter().map(field).collect();
    format!("{{\"__metadata__\":{{{}}}", fields.join(","))
}
