//! Python names that a pickle may use.

use crate::torch::values::{ElementType, Global};

/// Treatment of objects whose classes are not on the allow-list.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum UnknownClasses {
    #[default]
    Refuse,
    /// The objects are skipped, as [`Value::Opaque`](crate::torch::values::Value::Opaque).
    Skip,
}

pub(crate) enum UnpickleError {
    /// A Python name that is not allowed.
    Refused(String),
    Bad(String),
}

impl From<&str> for UnpickleError {
    fn from(what: &str) -> Self {
        Self::Bad(what.to_owned())
    }
}

/// Looks a Python name up in the allow-list; `None` for a name whose objects are skipped.
pub(crate) fn global(module: &str, name: &str, unknown: UnknownClasses) -> Result<Option<Global>, UnpickleError> {
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
    if unknown == UnknownClasses::Refuse || is_attack(module, name) {
        return Err(UnpickleError::Refused(escaped_name(module, name)));
    }
    Ok(match (module, name) {
        ("torch._utils", "_rebuild_parameter" | "_rebuild_parameter_with_state") => Some(Global::RebuildParameter),
        ("torch", "HalfStorage") => Some(Global::Storage(ElementType::F16)),
        ("torch", "BFloat16Storage") => Some(Global::Storage(ElementType::BF16)),
        _ => None,
    })
}

/// Formats a name of a possibly hostile file: at most 120 characters, without control characters.
pub(crate) fn escaped_name(module: &str, name: &str) -> String {
    let name: String = format!("{module}.{name}").chars().take(120).collect();
    name.escape_debug().to_string()
}

/// Returns whether the file is likely an attack on programs that execute pickles: no training program writes this name.
fn is_attack(module: &str, name: &str) -> bool {
    let package = module.split('.').next().unwrap_or_default();
    match package {
        "os" | "posix" | "nt" | "subprocess" | "pty" | "commands" | "shutil" | "socket" | "runpy" | "ctypes"
        | "webbrowser" | "importlib" | "pickle" | "_pickle" | "cPickle" | "marshal" | "timeit" | "requests"
        | "http" | "ftplib" | "smtplib" | "pdb" | "bdb" | "profile" | "cProfile" | "trace" | "doctest" | "sys"
        | "multiprocessing" | "asyncio" | "pip" | "pkgutil" => true,
        "builtins" | "__builtin__" => {
            matches!(name, "eval" | "exec" | "execfile" | "compile" | "open" | "__import__" | "input" | "breakpoint")
        }
        "urllib" | "urllib2" => module != "urllib.parse",
        // A project may have a package named `code`.
        "code" => module == "code",
        "torch" => match module {
            "torch" => matches!(name, "load" | "save" | "compile"),
            "torch.serialization" => name != "_get_layout", // pickled layouts use this name
            "torch.jit" => name == "load",
            "torch.utils.cpp_extension" => true,
            _ => module.starts_with("torch.hub") || module.starts_with("torch.package"),
        },
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn attacks_differ_from_names_of_training_programs() {
        for (module, name) in [
            ("os", "system"),
            ("builtins", "eval"),
            ("pickle", "loads"),
            ("_pickle", "loads"),
            ("timeit", "timeit"),
            ("urllib.request", "urlopen"),
            ("requests.api", "get"),
            ("code", "interact"),
            ("pdb", "run"),
            ("sys", "exit"),
            ("multiprocessing.util", "spawnv_passfds"),
            ("torch", "load"),
            ("torch.hub", "load"),
            ("torch.serialization", "load"),
        ] {
            assert!(is_attack(module, name), "{module}.{name}");
            assert!(matches!(global(module, name, UnknownClasses::Skip), Err(UnpickleError::Refused(_))));
        }
        for (module, name) in [
            ("builtins", "getattr"),
            ("builtins", "set"),
            ("torch", "device"),
            ("torch.serialization", "_get_layout"),
            ("torch.optim.lr_scheduler", "LambdaLR"),
            ("urllib.parse", "ParseResult"),
            ("code.config", "ModelConfig"),
            ("osgeo.osr", "SpatialReference"),
            ("pathlib", "PosixPath"),
        ] {
            assert!(!is_attack(module, name), "{module}.{name}");
        }
    }
}
