//! The Python names that a pickle may use.

use super::{Others, Stop};
use crate::pickle::{ElementType, Global};

/// Looks a Python name up in the allow-list; `None` for one that is to be passed over.
pub(super) fn global(module: &str, name: &str, others: Others) -> Result<Option<Global>, Stop> {
    let known = match (module, name) {
        ("torch._utils", "_rebuild_tensor_v2") => Some(Global::RebuildTensor),
        ("collections", "OrderedDict") => Some(Global::OrderedDict),
        ("torch", "ByteStorage") => Some(Global::Storage(ElementType::U8)),
        ("torch", "IntStorage") => Some(Global::Storage(ElementType::I32)),
        ("torch", "LongStorage") => Some(Global::Storage(ElementType::I64)),
        ("torch", "FloatStorage") => Some(Global::Storage(ElementType::F32)),
        ("torch", "DoubleStorage") => Some(Global::Storage(ElementType::F64)),
        _ => None,
    };
    if known.is_some() {
        return Ok(known);
    }
    if others == Others::Refuse || is_attack(module, name) {
        return Err(Stop::Refused(shown(module, name)));
    }
    Ok(match (module, name) {
        ("torch._utils", "_rebuild_parameter") => Some(Global::RebuildParameter),
        ("torch", "HalfStorage") => Some(Global::Storage(ElementType::F16)),
        ("torch", "BFloat16Storage") => Some(Global::Storage(ElementType::BF16)),
        _ => None,
    })
}

/// A name from a file that may be hostile: short enough for a terminal, and without control characters.
pub(super) fn shown(module: &str, name: &str) -> String {
    let name: String = format!("{module}.{name}").chars().take(120).collect();
    name.escape_debug().to_string()
}

/// Names that no training program writes into a checkpoint. They would not be run either, but whoever gave the file
/// away meant to run them elsewhere.
fn is_attack(module: &str, name: &str) -> bool {
    let package = module.split('.').next().unwrap_or_default();
    match package {
        "os" | "posix" | "nt" | "subprocess" | "pty" | "commands" | "shutil" | "socket" | "runpy" | "ctypes"
        | "webbrowser" | "importlib" => true,
        "builtins" | "__builtin__" => {
            matches!(name, "eval" | "exec" | "execfile" | "compile" | "open" | "__import__" | "input" | "breakpoint")
        }
        _ => false,
    }
}
