//! The direction of imports: reads the `use crate::` lines of `src/` and fails on one that the table does not allow.

use std::fs;
use std::path::{Path, PathBuf};

/// Module, then what it may import beside itself.
const ALLOWED: &[(&str, &[&str])] = &[
    ("error", &[]),
    ("index", &["error"]),
    ("context", &["error", "index"]),
    ("parameters", &["error", "index"]),
    ("statistics", &[]),
    ("parallel", &["error", "index", "context"]),
    ("geometry", &["error", "index", "context", "parallel"]),
    ("image", &["error", "index", "context", "parallel", "geometry"]),
    ("mesh", &["error", "index", "context", "statistics", "parallel", "geometry"]),
    ("sparse", &["error", "index", "context", "parallel"]),
    ("fem", &["error", "index", "context", "parallel", "geometry", "mesh", "sparse"]),
    ("io", &["error", "index", "context", "parallel", "geometry", "mesh", "image"]),
    (
        "lattice",
        &[
            "error",
            "index",
            "context",
            "parameters",
            "statistics",
            "parallel",
            "geometry",
            "image",
            "mesh",
            "fem",
            "sparse",
        ],
    ),
    ("conforming", &["error", "index", "context", "parameters", "statistics", "parallel", "geometry", "mesh"]),
    (
        "registration",
        &[
            "error",
            "index",
            "context",
            "parameters",
            "statistics",
            "parallel",
            "geometry",
            "image",
            "mesh",
            "fem",
            "sparse",
        ],
    ),
    (
        "pipeline",
        &[
            "error",
            "index",
            "context",
            "parameters",
            "statistics",
            "parallel",
            "geometry",
            "image",
            "mesh",
            "sparse",
            "fem",
            "io",
            "lattice",
            "conforming",
            "registration",
        ],
    ),
    (
        "capi",
        &[
            "error",
            "index",
            "context",
            "parameters",
            "statistics",
            "image",
            "mesh",
            "io",
            "lattice",
            "conforming",
            "registration",
            "pipeline",
        ],
    ),
];

fn rust_files(folder: &Path, files: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            rust_files(&path, files);
        } else if path.extension().is_some_and(|e| e == "rs") {
            files.push(path);
        }
    }
}

fn imported_modules(source: &str) -> Vec<String> {
    source
        .match_indices("crate::")
        .filter(|(at, _)| !source[..*at].lines().last().unwrap_or("").trim_start().starts_with("//"))
        .flat_map(|(at, _)| {
            let rest = &source[at + "crate::".len()..];
            match rest.strip_prefix('{') {
                Some(group) => group[..group.find('}').unwrap_or(0)].split(',').map(first_word).collect(),
                None => vec![first_word(rest)],
            }
        })
        .filter(|name| !name.is_empty())
        .collect()
}

fn first_word(text: &str) -> String {
    text.trim_start().chars().take_while(|c| c.is_ascii_alphanumeric() || *c == '_').collect()
}

#[test]
fn imports_point_downwards() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = Vec::new();
    rust_files(&root, &mut files);
    let mut faults = Vec::new();
    for file in files {
        let relative = file.strip_prefix(&root).unwrap();
        let module = relative.iter().next().unwrap().to_string_lossy().trim_end_matches(".rs").to_owned();
        let Some((_, allowed)) = ALLOWED.iter().find(|(name, _)| *name == module) else {
            assert!(["lib", "bin"].contains(&module.as_str()), "{module} is not in the table");
            continue;
        };
        for import in imported_modules(&fs::read_to_string(&file).unwrap()) {
            let is_module = ALLOWED.iter().any(|(name, _)| *name == import);
            if is_module && import != module && !allowed.contains(&import.as_str()) {
                faults.push(format!("{} imports {import}", relative.display()));
            }
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

/// The keys `[NameYear]` in doc comments, such as `[Bowyer1981]`.
fn cited_keys(source: &str) -> Vec<String> {
    let docs = source.lines().map(str::trim_start).filter(|line| line.starts_with("//"));
    docs.flat_map(|line| line.match_indices('[').map(|(at, _)| line[at + 1..].split(']').next().unwrap_or("")))
        .filter(|key| {
            let year = key.trim_start_matches(|c: char| c.is_ascii_alphabetic());
            key.starts_with(|c: char| c.is_ascii_uppercase())
                && key.len() > year.len()
                && year.len() == 4
                && year.chars().all(|c| c.is_ascii_digit())
        })
        .map(str::to_owned)
        .collect()
}

#[test]
fn every_cited_key_stands_in_the_references() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let references = fs::read_to_string(root.join("REFERENCES.md")).unwrap();
    let mut files = Vec::new();
    rust_files(&root.join("src"), &mut files);
    let mut missing: Vec<String> = files
        .iter()
        .flat_map(|file| cited_keys(&fs::read_to_string(file).unwrap()))
        .filter(|key| !references.contains(&format!("[{key}]")))
        .collect();
    missing.sort();
    missing.dedup();
    assert!(missing.is_empty(), "not in REFERENCES.md: {}", missing.join(", "));
}
