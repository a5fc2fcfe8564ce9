//! `include/meshwright.h` is what cbindgen makes of the sources. `MW_UPDATE_HEADER=1 cargo test --test header` writes it.

use std::path::Path;

fn generated(root: &Path) -> String {
    let mut config = cbindgen::Config::from_file(root.join("cbindgen.toml")).expect("cbindgen.toml is valid");
    let after = config.after_includes.take().expect("cbindgen.toml has after_includes");
    let after = after
        .replace("@MAJOR@", env!("CARGO_PKG_VERSION_MAJOR"))
        .replace("@MINOR@", env!("CARGO_PKG_VERSION_MINOR"))
        .replace("@PATCH@", env!("CARGO_PKG_VERSION_PATCH"));
    config.after_includes = Some(after);
    // The files of the C boundary, in the order in which a reader needs them. Parsing only them is fast, and keeps
    // the rest of the crate out of the header.
    let files = ["status", "guard", "context", "image", "surface", "sizing", "job", "results", "params", "mesh"];
    let builder = files.iter().fold(cbindgen::Builder::new().with_config(config), |builder, file| {
        builder.with_src(root.join("src/capi").join(file).with_extension("rs"))
    });
    let mut text = Vec::new();
    builder.generate().expect("cbindgen understands src/capi").write(&mut text);
    tidy(&String::from_utf8(text).expect("the header is UTF-8"))
}

/// Comments of one line on one line, negative constants in parentheses, no trailing blanks, no two empty lines in a row.
fn tidy(text: &str) -> String {
    let text = text.replace("\nMW_API\n", "\nMW_API ");
    let lines: Vec<&str> = text.lines().map(str::trim_end).collect();
    let mut tidied: Vec<String> = Vec::new();
    let mut at = 0;
    while at < lines.len() {
        let indent = &lines[at][..lines[at].len() - lines[at].trim_start().len()];
        let comment = lines.get(at..at + 3).filter(|l| l[0].trim() == "/**" && l[2].trim() == "*/");
        match comment.and_then(|l| l[1].trim().strip_prefix("* ")) {
            Some(words) if indent.len() + words.len() + 8 <= 120 => {
                tidied.push(format!("{indent}/** {words} */"));
                at += 3;
            }
            _ => {
                if let Some((name, number)) = lines[at].strip_prefix("#define ").and_then(|l| l.split_once(" -")) {
                    tidied.push(format!("#define {name} (-{number})"));
                } else if !(lines[at].is_empty() && tidied.last().is_none_or(|last| last.is_empty())) {
                    tidied.push(lines[at].to_owned());
                }
                at += 1;
            }
        }
    }
    tidied.join("\n") + "\n"
}

#[test]
fn header_is_current() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let path = root.join("include/meshwright.h");
    let expected = generated(root);
    if std::env::var_os("MW_UPDATE_HEADER").is_some() {
        std::fs::write(&path, &expected).unwrap();
    }
    let committed = std::fs::read_to_string(&path).unwrap_or_default();
    let difference = expected.lines().zip(committed.lines()).position(|(new, old)| new != old);
    assert!(
        committed == expected,
        "include/meshwright.h is stale (line {}); run MW_UPDATE_HEADER=1 cargo test --test header",
        difference.map_or(committed.lines().count().min(expected.lines().count()), |line| line) + 1
    );
}

/// Runs the system's C or C++ compiler over the header alone, every warning an error.
fn compile_header(name: &str, is_cpp: bool, standard: &str) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let host = format!("{}-unknown-linux-gnu", std::env::consts::ARCH);
    let mut build = cc::Build::new();
    build.cpp(is_cpp).target(&host).host(&host).opt_level(0).cargo_metadata(false);
    let output = build
        .get_compiler()
        .to_command()
        .args(["-x", if is_cpp { "c++" } else { "c" }, &format!("-std={standard}"), "-fsyntax-only"])
        .args(["-Wall", "-Wextra", "-Werror", "-pedantic", "-include"])
        .arg(root.join("include").join(name))
        .arg("/dev/null")
        .output()
        .expect("a C compiler is installed");
    assert!(output.status.success(), "{name}, {standard}: {}", String::from_utf8_lossy(&output.stderr));
}

#[cfg(target_os = "linux")]
#[test]
fn headers_compile_without_a_warning() {
    for standard in ["c99", "c11"] {
        compile_header("meshwright.h", false, standard);
    }
    for standard in ["c++11", "c++20"] {
        compile_header("meshwright.h", true, standard);
        compile_header("meshwright.hpp", true, standard);
    }
}
