//! What people and programs get to read: the line about a failure, findings, JSON.

use std::io::{IsTerminal, Write};
use std::path::Path;
use std::process::ExitCode;

use clap::error::{ContextKind, ContextValue, ErrorKind};
use meshwright::error::Severity;
use meshwright::{Error, Finding, Result, io};
use serde_json::{Map, Value, json};

use crate::exit_code;

/// Findings shown as lines before the rest is only counted; `--json` holds all of them.
const SHOWN_FINDINGS: usize = 20;

/// Prints help and version, or one line about a wrong command line.
pub fn usage_error(error: &clap::Error) -> ExitCode {
    if matches!(error.kind(), ErrorKind::DisplayHelp | ErrorKind::DisplayVersion) {
        // A closed pipe is no failure of ours.
        let _ = error.print();
        return ExitCode::SUCCESS;
    }
    let text = error.to_string();
    let first = text.lines().next().unwrap_or("").trim_start_matches("error: ").to_owned();
    let details: Vec<&str> = text.lines().skip(1).take_while(|l| l.starts_with("  ")).map(str::trim).collect();
    let suggestion = match error.get(ContextKind::SuggestedArg).or_else(|| error.get(ContextKind::SuggestedSubcommand))
    {
        Some(ContextValue::String(name)) => format!(", did you mean '{name}'?"),
        Some(ContextValue::Strings(names)) if !names.is_empty() => format!(", did you mean '{}'?", names[0]),
        _ => String::new(),
    };
    let first = if error.kind() == ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand {
        "no subcommand given; try --help".to_owned()
    } else {
        first
    };
    say(&format!(
        "{first}{}{suggestion}",
        if details.is_empty() { String::new() } else { format!(" {}", details.join(", ")) }
    ));
    ExitCode::from(exit_code::USAGE)
}

/// The exit code of a finished run; a failed one is told on stderr.
pub fn outcome(result: Result<()>) -> ExitCode {
    result.map_or_else(|error| failure(&error), |()| ExitCode::SUCCESS)
}

/// One line on stderr about what ended the run; findings below it.
pub fn failure(error: &Error) -> ExitCode {
    say(&error.to_string().replace('\n', " "));
    show_findings(error.findings());
    ExitCode::from(exit_code::of(error))
}

/// Prints findings to stderr, the first ones only.
pub fn show_findings(findings: &[Finding]) {
    for finding in findings.iter().take(SHOWN_FINDINGS) {
        let kind = match finding.severity {
            Severity::Note => "note",
            Severity::Warning => "warning",
            Severity::Error => "error",
        };
        say(&format!("{kind}: {}", finding.text));
    }
    if findings.len() > SHOWN_FINDINGS {
        say(&format!("and {} more; --json lists all", findings.len() - SHOWN_FINDINGS));
    }
}

fn say(line: &str) {
    let mut stderr = std::io::stderr().lock();
    let clear = if stderr.is_terminal() { "\r\x1b[K" } else { "" };
    // Where stderr is closed there is nobody to tell.
    let _ = writeln!(stderr, "{clear}meshwright: {line}");
}

/// Findings as JSON: code, severity, ids, point (null where there is none), text.
pub fn findings_json(findings: &[Finding]) -> Value {
    let one = |finding: &Finding| {
        let point = if finding.point.iter().all(|c| c.is_finite()) { json!(finding.point) } else { Value::Null };
        json!({
            "code": format!("{:?}", finding.code),
            "number": finding.code as i32,
            "severity": format!("{:?}", finding.severity).to_lowercase(),
            "ids": finding.ids,
            "point": point,
            "text": finding.text,
        })
    };
    Value::Array(findings.iter().map(one).collect())
}

/// A finite number as JSON, anything else as null.
pub fn number(value: f64) -> Value {
    // Counts stay whole numbers: 2^53 is the last one that a double holds exactly.
    if value.fract() == 0.0 && value.abs() < 9e15 { json!(value as i64) } else { json!(value) }
}

/// Statistics with dotted names as nested objects; a name that is both a figure and a group keeps its figure under
/// `value`.
pub fn nested(entries: &[(String, f64)]) -> Map<String, Value> {
    let mut root = Map::new();
    for (name, value) in entries {
        let mut group = &mut root;
        let mut parts = name.split('.').peekable();
        while let Some(part) = parts.next() {
            if parts.peek().is_none() {
                match group.get_mut(part) {
                    Some(Value::Object(object)) => object.insert("value".into(), number(*value)),
                    _ => group.insert(part.to_owned(), number(*value)),
                };
                break;
            }
            let entry = group.entry(part).or_insert_with(|| Value::Object(Map::new()));
            if !entry.is_object() {
                *entry = json!({ "value": entry.clone() });
            }
            group = entry.as_object_mut().expect("made an object above");
        }
    }
    root
}

/// Writes JSON to a file, or to stdout for `-`.
///
/// # Errors
/// [`Error::Io`].
pub fn write_json(value: &Value, path: &Path) -> Result<()> {
    let text = format!("{value:#}\n");
    if path == Path::new("-") {
        return print(&text);
    }
    io::write_atomically(path, |writer| writer.write_all(text.as_bytes()))
}

/// Prints to stdout; a reader that has closed the pipe is no failure.
///
/// # Errors
/// [`Error::Io`].
pub fn print(text: &str) -> Result<()> {
    let mut stdout = std::io::stdout().lock();
    match stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()) {
        Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => Err(Error::io("standard output", error)),
        _ => Ok(()),
    }
}
