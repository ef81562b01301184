//! Generates `docs/reference/config.md` from the doc comments and defaults of [`Config`]:
//! `CLIFT_UPDATE=1 cargo test --release --workspace --lib page_is_current` rewrites the page.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::fs;
use std::path::Path;

use clift_train::Config;
use toml::{Table, Value};

/// Structs of the source files by name: doc comment, and name, type and doc comment of each public field.
type Structs = BTreeMap<String, (String, Vec<[String; 3]>)>;

fn cell(text: &str) -> String {
    text.replace("\n\n", ". ").replace('\n', " ").replace('|', "\\|").replace('<', "\\<")
}

#[test]
fn config_page_is_current() {
    let mut structs = Structs::new();
    for name in ["clift-data", "clift-eval", "clift-model", "clift-train"] {
        read_structs(&Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(name).join("src"), &mut structs);
    }
    let defaults = Table::try_from(Config::default()).expect("a table");
    let mut page =
        "# Config\n\nGenerated from the doc comments of `Config`. `--set KEY=TOML` overrides a key.\n".to_owned();
    add_section("", &structs["Config"].1, &defaults, &structs, &mut page);
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/reference/config.md");
    if std::env::var_os("CLIFT_UPDATE").is_some() {
        fs::write(&path, &page).expect("writable page");
    }
    let current = fs::read_to_string(&path).unwrap_or_default();
    assert!(page == current, "{} is outdated; `CLIFT_UPDATE=1` rewrites the page", path.display());
}

fn read_structs(folder: &Path, structs: &mut Structs) {
    for entry in fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            read_structs(&path, structs);
            continue;
        }
        let (mut doc, mut name, mut is_skipped) = (String::new(), String::new(), false);
        for line in fs::read_to_string(&path).expect("a source file").lines() {
            if let Some(text) = line.trim_start().strip_prefix("///") {
                doc.push_str(text);
            } else if let Some(declared) = line.strip_prefix("pub struct ").and_then(|line| line.strip_suffix(" {")) {
                name = declared.to_owned();
                structs.insert(name.clone(), (std::mem::take(&mut doc), Vec::new()));
            } else if let Some((field, kind)) = line.strip_prefix("    pub ").and_then(|line| line.split_once(": "))
                && let Some((_, fields)) = structs.get_mut(&name)
            {
                if !std::mem::take(&mut is_skipped) {
                    fields.push([field, kind.trim_end_matches(','), doc.trim()].map(String::from));
                }
                doc.clear();
            } else if line.trim() == "#[serde(skip)]" {
                is_skipped = true;
            } else if !line.trim_start().starts_with("#[") {
                doc.clear();
                name = if line.starts_with('}') { String::new() } else { name };
            }
        }
    }
}

fn add_section(path: &str, fields: &[[String; 3]], defaults: &Table, structs: &Structs, page: &mut String) {
    let is_section =
        |[name, kind, _]: &&[String; 3]| structs.contains_key(kind) && defaults.get(name).is_some_and(Value::is_table);
    page.push_str("\n| key | default | |\n|---|---|---|\n");
    for [name, kind, doc] in fields.iter().filter(|field| !is_section(field)) {
        let has_default = defaults.contains_key(name) || kind.starts_with("Option<");
        assert!(has_default, "a written config omits {path}.{name} at its default");
        let default = defaults.get(name).map_or("unset".to_owned(), |value| format!("`{value}`"));
        writeln!(page, "| `{name}` | {default} | {} |", cell(doc)).unwrap();
    }
    for [name, kind, _] in fields.iter().filter(is_section) {
        let path = if path.is_empty() { name.clone() } else { format!("{path}.{name}") };
        let (doc, fields) = &structs[kind];
        write!(page, "\n## [{path}]\n\n{}\n", doc.trim()).unwrap();
        add_section(&path, fields, defaults[name].as_table().expect("a table"), structs, page);
    }
}
