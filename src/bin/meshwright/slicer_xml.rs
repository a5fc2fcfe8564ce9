//! 3D Slicer's description of a subcommand, made from the parameter table.
//!
//! # Method
//! A row becomes the element of its kind; files become images, models and transforms that Slicer loads and saves by
//! itself. Slicer allows no hyphen in a flag: it gets the spelling with underscores. What can be left out is a text field, because Slicer has no empty number; an empty text counts as not given.

use std::fmt::Write;

use meshwright::parameters::{Kind, Multiplicity, Parameter, Value};
use meshwright::pipeline::JobKind;

use crate::job_outputs::RETURN_PARAMETERS;

/// Rows that are points a user places in the scene.
const POINT_ROWS: [&str; 2] = ["hole", "fixed-point"];
/// Image rows that hold labels.
const LABEL_ROWS: [&str; 5] = ["image", "segmented-image", "fixed-mask", "output-segmentation", "output-target-image"];
/// Image rows that hold displacements, which Slicer loads as transforms.
const FIELD_ROWS: [&str; 2] = ["output-deformation-field", "output-inverse-field"];

/// The XML of a subcommand.
pub fn describe(kind: JobKind) -> String {
    let (category, title) = match kind {
        JobKind::ImageToMesh => ("Mesh Generation", "Meshwright Image to Mesh"),
        JobKind::SurfaceToMesh => ("Mesh Generation", "Meshwright Surface to Mesh"),
        JobKind::Registration => ("Registration", "Meshwright Brain Shift Registration"),
    };
    let mut xml = String::from("<?xml version=\"1.0\" encoding=\"utf-8\"?>\n<executable>\n");
    let mut line = |indent: usize, text: &str| {
        xml.push_str(&"  ".repeat(indent));
        xml.push_str(text);
        xml.push('\n');
    };
    line(1, &format!("<category>{category}</category>"));
    line(1, &format!("<title>{title}</title>"));
    line(
        1,
        "<description><![CDATA[Meshwright: permissively licensed mesh generation and registration.]]></description>",
    );
    line(1, &format!("<version>{}</version>", env!("CARGO_PKG_VERSION")));
    line(1, "<license>MIT OR Apache-2.0</license>");
    line(1, "<contributor>The Meshwright authors</contributor>");
    let mut groups: Vec<&str> = Vec::new();
    for parameter in kind.parameters() {
        if !groups.contains(&parameter.group) {
            groups.push(parameter.group);
        }
    }
    for (position, group) in groups.iter().enumerate() {
        // Files and the first group of settings open, the rest folded.
        let advanced = if position > 1 { " advanced=\"true\"" } else { "" };
        line(1, &format!("<parameters{advanced}>"));
        line(2, &format!("<label>{}</label>", escaped(group)));
        line(2, &format!("<description><![CDATA[{group}]]></description>"));
        for parameter in kind.parameters().iter().filter(|p| p.group == *group) {
            elements(parameter).iter().for_each(|text| line(2, text));
        }
        line(1, "</parameters>");
    }
    line(1, "<parameters advanced=\"true\">");
    line(2, "<label>Run</label>");
    line(2, "<description><![CDATA[How the run behaves]]></description>");
    if !kind.parameters().iter().any(|p| p.name == "threads") {
        line(
            2,
            "<integer><name>threads</name><longflag>threads</longflag><label>Threads</label><description><![CDATA[Worker threads; 0 takes one per core.]]></description><default>0</default><constraints><minimum>0</minimum><maximum>1024</maximum><step>1</step></constraints></integer>",
        );
    }
    line(
        2,
        "<boolean hidden=\"true\"><name>slicer_progress</name><longflag>slicer_progress</longflag><label>Progress</label><description><![CDATA[Report progress to Slicer.]]></description><default>true</default></boolean>",
    );
    line(1, "</parameters>");
    line(1, "<parameters>");
    line(2, "<label>Results</label>");
    line(2, "<description><![CDATA[Figures of the result]]></description>");
    for (name, figure) in RETURN_PARAMETERS {
        line(
            2,
            &format!(
                "<double><name>{name}</name><label>{}</label><description><![CDATA[{figure}]]></description><channel>output</channel><default>0</default></double>",
                name.replace('_', " ")
            ),
        );
    }
    line(1, "</parameters>");
    xml.push_str("</executable>\n");
    xml
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// What every element has: name, flag, label, description.
fn common(name: &str, doc: &str, unit: &str) -> String {
    let identifier = name.replace('-', "_");
    let mut label = name.replace('-', " ");
    if let Some(first) = label.get_mut(0..1) {
        first.make_ascii_uppercase();
    }
    let unit = if unit.is_empty() { String::new() } else { format!(" [{unit}]") };
    format!(
        "<name>{identifier}</name><longflag>{identifier}</longflag><label>{}</label><description><![CDATA[{doc}]]></description>",
        escaped(&format!("{label}{unit}"))
    )
}

fn elements(parameter: &Parameter) -> Vec<String> {
    let mut all = vec![element(parameter)];
    if parameter.multiplicity == Multiplicity::PerLabel {
        let name = format!("{}-for", parameter.name);
        let doc = format!("For single labels: LABEL=VALUE. {}", parameter.doc);
        all.push(format!(
            "<string multiple=\"true\">{}<default></default></string>",
            common(&name, &doc, parameter.unit)
        ));
    }
    all
}

fn element(parameter: &Parameter) -> String {
    let common = common(parameter.name, parameter.doc, parameter.unit);
    let multiple = if parameter.multiplicity == Multiplicity::Repeatable { " multiple=\"true\"" } else { "" };
    if POINT_ROWS.contains(&parameter.name) {
        return format!("<point multiple=\"true\" coordinateSystem=\"lps\">{common}</point>");
    }
    match (parameter.kind, parameter.default_value()) {
        (Kind::InputFile { extensions }, _) => file_element(parameter.name, extensions, "input", &common),
        (Kind::OutputFile { extensions }, _) => file_element(parameter.name, extensions, "output", &common),
        (Kind::Flag, Some(Value::Flag(false)) | None) => format!("<boolean>{common}<default>false</default></boolean>"),
        // A switch that is on by default is a choice: Slicer can only add flags, not take them away.
        (Kind::Flag, _) => enumeration(&common, &["on", "off"], "on"),
        (Kind::Choice(choices), default) => {
            let default = match default {
                Some(Value::Integer(v)) => choices.get(v as usize).copied().unwrap_or(choices[0]),
                _ => choices[0],
            };
            enumeration(&common, choices, default)
        }
        (Kind::Integer { min, max }, Some(Value::Integer(v))) => {
            // Slicer's whole numbers have 32 bits.
            let (min, max) = (min.max(i64::from(i32::MIN)), max.min(i64::from(i32::MAX)));
            format!(
                "<integer>{common}<default>{v}</default><constraints><minimum>{min}</minimum><maximum>{max}</maximum><step>1</step></constraints></integer>"
            )
        }
        (Kind::Real { min, max, .. }, Some(Value::Real(v))) => {
            let mut limits = String::new();
            let high = if max.is_finite() { max } else { 1e9 };
            // A step a user can see the effect of: a hundredth of the default.
            let step = if v == 0.0 { 0.01 } else { v.abs() / 100.0 };
            let _ = write!(limits, "<minimum>{min}</minimum><maximum>{high}</maximum><step>{step}</step>");
            format!("<double>{common}<default>{v}</default><constraints>{limits}</constraints></double>")
        }
        (_, default) => {
            let default = match default {
                Some(Value::Text(text)) => escaped(&text),
                _ => String::new(),
            };
            format!("<string{multiple}>{common}<default>{default}</default></string>")
        }
    }
}

fn enumeration(common: &str, choices: &[&str], default: &str) -> String {
    let items: String = choices.iter().map(|c| format!("<element>{}</element>", escaped(c))).collect();
    format!("<string-enumeration>{common}<default>{}</default>{items}</string-enumeration>", escaped(default))
}

fn file_element(name: &str, extensions: &[&str], channel: &str, common: &str) -> String {
    let tail = format!("{common}<channel>{channel}</channel>");
    if FIELD_ROWS.contains(&name) {
        return format!("<transform fileExtensions=\".nrrd\" type=\"nonlinear\">{tail}</transform>");
    }
    if extensions.contains(&".nrrd") {
        let kind = if LABEL_ROWS.contains(&name) { "label" } else { "scalar" };
        return format!("<image type=\"{kind}\" fileExtensions=\".nrrd\">{tail}</image>");
    }
    let models: Vec<&str> =
        [".vtk", ".vtu", ".vtp", ".stl", ".ply", ".obj"].into_iter().filter(|e| extensions.contains(e)).collect();
    if !models.is_empty() {
        return format!("<geometry type=\"model\" fileExtensions=\"{}\">{tail}</geometry>", models.join(","));
    }
    format!("<file fileExtensions=\"{}\">{tail}</file>", extensions.join(","))
}
