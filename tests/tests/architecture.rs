//! The rules of the layout, checked on the sources: which crate, folder and file imports which.

use std::collections::{BTreeMap, BTreeSet};

use crate::support::sources;

/// A crate, the crates that it may use, and its folders and root files: each imports only those that stand before it.
type Crate = (&'static str, &'static str, &'static str);

const CRATES: [Crate; 11] = [
    ("clift-core", "", "error statistics random rgb_image files geometry clip_views"),
    (
        "clift-kernels",
        "",
        "simd primitives attention bf16_values cluster_attention gelu head_transform layer_norm linear matmul_bf16 rms_norm",
    ),
    ("clift-cube", "", "adapter ledger buffers rows products attention"),
    (
        "clift-model",
        "clift-core clift-cube clift-kernels",
        "error names device ops views tokens network cost weights metrics",
    ),
    (
        "clift-data",
        "clift-core",
        "error skip_report files geometry image torch scene_source synthetic sources sampling config \
         tools dataset",
    ),
    ("clift-scene", "clift-core clift-kernels clift-model clift-data", "error tensors codec scene check encode"),
    (
        "clift-eval",
        "clift-core clift-kernels clift-model clift-data clift-scene",
        "error system config statistics sweep figures report evaluator",
    ),
    (
        "clift-train",
        "clift-core clift-kernels clift-model clift-data clift-scene clift-eval",
        "error version distributed events config step cluster_cache interchange stage checkpoint footprint \
         fit_token_codec run",
    ),
    (
        "clift-bench",
        "clift-core clift-kernels clift-model clift-data clift-scene clift-eval clift-train",
        "cases runner ledger doctor",
    ),
    (
        "clift-view",
        "clift-core clift-kernels clift-model clift-data clift-scene clift-eval",
        "error protocol scenes session server",
    ),
    (
        "clift",
        "clift-core clift-kernels clift-model clift-data clift-scene clift-eval clift-train clift-bench clift-view",
        "verbosity interrupt exit_code output threads commands cli reference_pages",
    ),
];

/// Most lines of production code of a file: one idea a file.
const MAX_LINES: usize = 600;

#[test]
fn sources_keep_the_layout() {
    let sources = sources(&["crates"], &["rs", "toml"]);
    let mut found = violations(&sources);
    let names = sources.keys().filter_map(|path| path.split('/').nth(1)).collect::<BTreeSet<_>>();
    let known = |name: &&str| CRATES.iter().any(|(one, ..)| one == name);
    found.extend(names.into_iter().filter(|name| !known(name)).map(|name| format!("{name} is not in CRATES")));
    assert!(found.is_empty(), "{} violations:\n{}", found.len(), found.join("\n"));
}

/// Texts of files by their path in the repository.
type Sources = BTreeMap<String, String>;

/// Files of a crate by their module paths.
type Modules<'a> = BTreeMap<String, Module<'a>>;

/// What breaks a rule, as `path:line: what`.
fn violations(sources: &Sources) -> Vec<String> {
    let mut found = Vec::new();
    for (name, uses, order) in CRATES {
        check_dependencies(name, uses, sources, &mut found);
        let root = format!("crates/{name}/src/");
        let files = sources.iter().filter_map(|(path, text)| {
            let name = module_of(path.strip_prefix(&root)?.strip_suffix(".rs")?)?;
            Some((name, Module { path, text, code: production(text) }))
        });
        let modules: Modules = files.collect();
        for (name, module) in &modules {
            check_file(name, module, &modules, &mut found);
        }
        check_imports(order, &modules, &mut found);
    }
    found
}

/// A source file that is no test.
struct Module<'a> {
    path: &'a str,
    text: &'a str,
    /// Its lines without comments and tests.
    code: Vec<&'a str>,
}

impl Module<'_> {
    fn is_folder(&self) -> bool {
        self.path.ends_with("/mod.rs")
    }
}

/// The module path of a file below `src/`, empty for `lib.rs`; `None` for tests and the binary.
fn module_of(path: &str) -> Option<String> {
    let is_test = path.split('/').any(|part| ["tests", "testing"].contains(&part));
    let name = if path == "lib" { "" } else { path.strip_suffix("/mod").unwrap_or(path) };
    (!is_test && path != "main").then(|| name.replace('/', "::"))
}

/// The lines of a file, those of comments and of `#[cfg(test)]` items empty.
fn production(text: &str) -> Vec<&str> {
    let (mut lines, mut indent_of_test) = (Vec::new(), None);
    for line in text.lines() {
        let code = line.split("//").next().unwrap_or_default();
        let indent = line.len() - line.trim_start().len();
        if indent_of_test.is_none() && code.trim() == "#[cfg(test)]" {
            indent_of_test = Some(indent);
        }
        lines.push(if indent_of_test.is_some() { "" } else { code });
        // The item ends where a line as far to the left ends with `;` or `}`.
        if indent_of_test == Some(indent) && code.trim_end().ends_with([';', '}']) {
            indent_of_test = None;
        }
    }
    lines
}

/// Crates depend on those below them.
fn check_dependencies(name: &str, uses: &str, sources: &Sources, found: &mut Vec<String>) {
    let path = format!("crates/{name}/Cargo.toml");
    let lines = sources.get(&path).map(String::as_str).unwrap_or_default().lines().enumerate();
    for (number, line) in lines.skip_while(|(_, line)| !line.contains("dependencies]")) {
        let used = line.split([' ', '.', '=']).next().unwrap_or_default();
        if CRATES.iter().any(|(other, ..)| *other == used) && !uses.split(' ').any(|allowed| allowed == used) {
            found.push(format!("{path}:{}: {name} does not stand above {used}", number + 1));
        }
    }
}

/// Pages of folders, private modules, one idea a file.
fn check_file(name: &str, module: &Module, modules: &Modules, found: &mut Vec<String>) {
    let mut add = |line: usize, what: &str| found.push(format!("{}:{line}: {what}", module.path));
    if name.rsplit_once("::").is_some_and(|(folder, _)| modules.get(folder).is_none_or(|page| !page.is_folder())) {
        add(1, "its folder has no mod.rs");
    }
    if module.is_folder() && !module.text.starts_with("//! ") {
        add(1, "a mod.rs without a page");
    }
    let num_lines = module.code.iter().filter(|line| !line.trim().is_empty()).count();
    if num_lines > MAX_LINES {
        add(1, &format!("{num_lines} lines of code, at most {MAX_LINES}"));
    }
    for (number, line) in (1..).zip(&module.code) {
        // What rustfmt puts at the start of a line begins an item.
        let item = line.trim_start_matches("pub").trim_start_matches("(crate)").trim_start();
        let is_code = line.starts_with(char::is_alphabetic) && !item.starts_with("mod ") && !item.starts_with("use ");
        if module.is_folder() && is_code {
            add(number, "code in a mod.rs");
        }
        if name.is_empty() && line.starts_with("pub mod ") {
            add(number, "a public module of a crate");
        }
    }
}

/// Folders import what stands before them, and files import each other in no circle.
fn check_imports(order: &str, modules: &Modules, found: &mut Vec<String>) {
    let mut imports = Vec::new();
    for (name, module) in modules.iter().filter(|(_, module)| !module.is_folder()) {
        for (path, line) in paths(name, &module.code) {
            match resolve(&path, modules) {
                Some(file) if file == *name => {}
                Some(file) => imports.push((name.clone(), file, line)),
                // The root may name a folder itself, to call into its files.
                None if name.is_empty() && modules.contains_key(&path) => {}
                None => found.push(format!("{}:{line}: `{path}` is in no file", module.path)),
            }
        }
    }
    let mut edges = BTreeMap::<&str, BTreeSet<&str>>::new();
    for (from, to, _) in &imports {
        edges.entry(from).or_default().insert(to);
    }
    let top = |name: &str| name.split("::").next().map(str::to_owned).unwrap_or_default();
    let place = |name: &str| order.split_whitespace().position(|part| part == top(name));
    for (from, to, line) in &imports {
        let path = modules[from].path;
        let is_before = place(to).is_some_and(|to| place(from).is_some_and(|from| to < from));
        if top(from) != top(to) && !from.is_empty() && !is_before {
            found.push(format!("{path}:{line}: {} does not stand behind {}", top(from), top(to)));
        } else if reaches(to, from, &edges) {
            found.push(format!("{path}:{line}: {from} is in a circle with {to}"));
        }
    }
}

/// Whether imports lead from one file to another one.
fn reaches(from: &str, to: &str, edges: &BTreeMap<&str, BTreeSet<&str>>) -> bool {
    let (mut seen, mut next) = (BTreeSet::from([from]), vec![from]);
    while let Some(file) = next.pop() {
        next.extend(edges.get(file).into_iter().flatten().filter(|file| seen.insert(file)));
    }
    seen.contains(to)
}

/// The file that a path leads to: by the longest module in it, through the `pub use` of a folder.
fn resolve(path: &str, modules: &Modules) -> Option<String> {
    let ends = path.match_indices("::").map(|(at, _)| at).chain([path.len()]);
    let (name, module) = ends.filter_map(|end| modules.get_key_value(&path[..end])).last()?;
    if !module.is_folder() {
        return Some(name.clone());
    }
    let item = path[name.len()..].split("::").nth(1)?;
    let code = module.code.join(" ");
    let exported = code.split("use ").skip(1).flat_map(tree).find(|export| export.rsplit("::").next() == Some(item))?;
    resolve(&format!("{name}::{}", exported.trim_start_matches("self::")), modules)
}

/// Every path of a file that starts with `crate::` or `super::`, from the root of the crate, with its line.
fn paths(name: &str, code: &[&str]) -> Vec<(String, usize)> {
    let (mut found, mut is_inner) = (Vec::new(), false);
    for (number, line) in code.iter().enumerate() {
        // Inside of `mod inner { .. }`, where `super` is this file.
        is_inner = *line != "}" && (is_inner || line.contains("mod ") && line.ends_with('{'));
        let name = if is_inner { &format!("{name}::inner") } else { name };
        let starts = ["crate::", "super::"].into_iter().flat_map(|start| line.match_indices(start));
        let is_inside = |at: usize| line[..at].ends_with(|c: char| c.is_alphanumeric() || "_:$".contains(c));
        for (at, _) in starts.filter(|(at, _)| !is_inside(*at)) {
            for path in tree(&format!("{} {}", &line[at..], code[number + 1..].join(" "))) {
                let (mut above, mut below) = (name, path.trim_start_matches("crate::"));
                while let Some(rest) = below.strip_prefix("super::") {
                    (above, below) = (above.rsplit_once("::").map_or("", |(above, _)| above), rest);
                }
                let is_absolute = above.is_empty() || path.starts_with("crate::");
                let below = below.trim_end_matches("::self");
                let path = if is_absolute { below.to_owned() } else { format!("{above}::{below}") };
                found.push((path, number + 1));
            }
        }
    }
    found
}

/// The paths of a `use` tree at the start of a text, or its one path.
fn tree(text: &str) -> Vec<String> {
    let text = text.trim_start();
    let end = text.find(|c: char| !c.is_alphanumeric() && c != '_' && c != ':').unwrap_or(text.len());
    let start = &text[..end];
    let Some(group) = text[end..].strip_prefix('{').filter(|_| start.ends_with("::")) else {
        return vec![start.trim_end_matches(':').to_owned()];
    };
    let (mut depth, mut from, mut paths) = (0, 0, Vec::new());
    for (at, c) in group.char_indices() {
        if depth == 0 && [',', '}'].contains(&c) {
            let inner = tree(&group[from..at]).into_iter().filter(|inner| !inner.is_empty());
            paths.extend(inner.map(|inner| format!("{start}{inner}")));
            from = at + 1;
        }
        match c {
            '{' => depth += 1,
            '}' if depth == 0 => break,
            '}' => depth -= 1,
            _ => {}
        }
    }
    paths
}

#[test]
fn each_rule_reports_file_and_line() {
    let block =
        ("src/network/block.rs", "use crate::error::ModelError;\n#[cfg(test)]\nmod tests { use crate::lvsm::X; }\n");
    let right = [
        ("Cargo.toml", "[dependencies]\nclift-kernels.workspace = true\n"),
        ("src/lib.rs", "//! Model.\nmod error;\nmod network;\npub use network::{Model, block::Block};\n"),
        ("src/error.rs", "pub enum ModelError {}\n"),
        (
            "src/network/mod.rs",
            "//! Networks.\n\n#[cfg(test)]\nmod tests;\nmod block;\npub use model::Model;\nmod model;\n",
        ),
        block,
        ("src/network/model.rs", "use super::block::Block;\nfn f() -> crate::error::ModelError {}\n"),
        ("src/network/model/tests.rs", "use crate::scene::Scene;\n"),
    ];
    let with = |changed: (&str, &str)| {
        let files = right.iter().chain([&changed]);
        violations(&files.map(|(path, text)| (format!("crates/clift-model/{path}"), (*text).to_owned())).collect())
    };
    assert_eq!(with(block), [] as [&str; 0]);
    for (path, text, expected) in [
        ("Cargo.toml", "\n[dependencies]\nclift-data = {}\n", "3: clift-model does not stand above clift-data"),
        ("src/lib.rs", "pub mod error;\npub use crate::error::ModelError;\n", "1: a public module of a crate"),
        ("src/error.rs", "\nuse crate::{network::{Model, block::Block}};\n", "2: error does not stand behind network"),
        ("src/other.rs", "use crate::error::ModelError;\n", "1: other does not stand behind error"),
        ("src/network/block.rs", "\nuse super::{\n    Model,\n};\n", "2: network::block is in a circle"),
        ("src/network/block.rs", "use crate::ModelError;\n", "1: `ModelError` is in no file"),
        ("src/network/mod.rs", "mod block;\n", "1: a mod.rs without a page"),
        ("src/network/mod.rs", "//! A page.\nmod block;\npub struct Model;\n", "3: code in a mod.rs"),
        ("src/scene/read.rs", "", "1: its folder has no mod.rs"),
        ("src/error.rs", &"struct A;\n".repeat(601), "1: 601 lines of code"),
    ] {
        let found = with((path, text));
        let expected = format!("crates/clift-model/{path}:{expected}");
        assert!(found.iter().any(|one| one.starts_with(&expected)), "{expected}: {found:?}");
    }
}
