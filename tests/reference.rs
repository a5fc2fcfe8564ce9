//! The parameter reference `docs/parameters.md` is made from the parameter tables; this test fails when it is stale.
//! `MESHWRIGHT_UPDATE=1 cargo test --test reference` writes it anew.

use std::fmt::Write;
use std::path::Path;

use meshwright::parameters::{Default, Kind, Multiplicity, Parameter, Table};
use meshwright::pipeline::JobKind;

fn kind_text(kind: &Kind) -> String {
    match kind {
        Kind::Flag => "on or off".into(),
        Kind::Integer { min, max } if *max == i64::MAX => format!("whole number, at least {min}"),
        Kind::Integer { min, max } => format!("whole number, {min} to {max}"),
        Kind::Real { min, max, open_min } => {
            let low = if *open_min { format!("above {min}") } else { format!("at least {min}") };
            if max.is_infinite() { format!("number, {low}") } else { format!("number, {low}, at most {max}") }
        }
        Kind::Choice(choices) => {
            choices.iter().enumerate().map(|(i, c)| format!("{i} `{c}`")).collect::<Vec<_>>().join(", ")
        }
        Kind::Text => "text".into(),
        Kind::InputFile { extensions } => format!("file to read ({})", extensions.join(" ")),
        Kind::OutputFile { extensions } => format!("file to write ({})", extensions.join(" ")),
    }
}

fn default_text(parameter: &Parameter) -> String {
    match parameter.default {
        Default::Unset => "not set".into(),
        Default::Flag(value) => if value { "on" } else { "off" }.into(),
        Default::Integer(value) => match parameter.kind {
            Kind::Choice(choices) => format!("`{}`", choices[value as usize]),
            _ => value.to_string(),
        },
        Default::Real(value) => value.to_string(),
        Default::Text(value) => format!("`{value}`"),
    }
}

fn write_table(page: &mut String, table: Table) {
    let mut groups: Vec<&str> = Vec::new();
    for parameter in table {
        if !groups.contains(&parameter.group) {
            groups.push(parameter.group);
        }
    }
    for group in groups {
        writeln!(page, "\n### {group}\n\n| parameter | value | default | |\n|---|---|---|---|").unwrap();
        for parameter in table.iter().filter(|p| p.group == group) {
            let alias = parameter.alias.map(|a| format!("<br>`{a}`")).unwrap_or_default();
            let unit = if parameter.unit.is_empty() { String::new() } else { format!(" [{}]", parameter.unit) };
            let often = match parameter.multiplicity {
                Multiplicity::Single => "",
                Multiplicity::PerLabel => " Can be given per label.",
                Multiplicity::Repeatable => " Can be given several times.",
            };
            writeln!(
                page,
                "| `{}`{alias} | {}{unit} | {} | {}{often} |",
                parameter.name,
                kind_text(&parameter.kind).replace('|', "\\|"),
                default_text(parameter),
                parameter.doc.replace('|', "\\|"),
            )
            .unwrap();
        }
    }
}

fn reference_page() -> String {
    let mut page = String::from(
        "# Parameter reference\n\n\
         Made from the library's parameter tables; do not edit. On the command line a parameter is `--name value` (also under \
         the second name, which is the dissertation's), in C `mw_job_set_f64`, `mw_job_set_i64` or `mw_job_set_str`, in SOFA \
         `parameters=\"name=value\"`.\n",
    );
    for kind in JobKind::ALL {
        writeln!(page, "\n## {}", kind.name()).unwrap();
        write_table(&mut page, kind.parameters());
    }
    page
}

#[test]
fn the_reference_page_is_current() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/parameters.md");
    let page = reference_page();
    if std::env::var_os("MESHWRIGHT_UPDATE").is_some() {
        std::fs::write(&path, &page).unwrap();
    }
    let stored = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(stored == page, "docs/parameters.md is stale: run MESHWRIGHT_UPDATE=1 cargo test --test reference");
}
