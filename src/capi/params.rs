//! Introspection of the parameter tables.
//!
//! # Method
//! The tables are static Rust data without terminators; their C copies are made once, on first use, and live for ever.

use std::ffi::{CString, c_char};
use std::sync::OnceLock;

use super::guard::{guard, to_c_string};
use super::handles::write;
use super::slices::write_sized;
use super::status::mw_status;
use crate::error::{Error, Result};
use crate::parameters::{Default, Kind, Multiplicity, Parameter};
use crate::pipeline::JobKind;

/// Kind of a parameter: on or off; set with mw_job_set_i64 (0, 1).
pub const MW_PARAM_FLAG: i32 = 1;
/// Kind of a parameter: whole number; set with mw_job_set_i64.
pub const MW_PARAM_INTEGER: i32 = 2;
/// Kind of a parameter: number; set with mw_job_set_f64.
pub const MW_PARAM_REAL: i32 = 3;
/// Kind of a parameter: one of `choices`; set by name with mw_job_set_str, by position with mw_job_set_i64.
pub const MW_PARAM_CHOICE: i32 = 4;
/// Kind of a parameter: text; set with mw_job_set_str.
pub const MW_PARAM_TEXT: i32 = 5;
/// Kind of a parameter: a file that the command line reads. Not for mw_job_set_str: hand data over instead.
pub const MW_PARAM_INPUT_FILE: i32 = 6;
/// Kind of a parameter: a file that the command line writes. Not for mw_job_set_str: take results instead.
pub const MW_PARAM_OUTPUT_FILE: i32 = 7;

/// A parameter is given once.
pub const MW_PARAM_SINGLE: i32 = 0;
/// A parameter is given once for all labels, and once per label (mw_job_set_f64_for).
pub const MW_PARAM_PER_LABEL: i32 = 1;
/// A parameter is given any number of times; each mw_job_set_str adds a value.
pub const MW_PARAM_REPEATABLE: i32 = 2;

/// Describes a parameter. Set `struct_size` before the call. All strings are static.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct mw_param_info {
    /// sizeof(mw_param_info)
    pub struct_size: usize,
    /// Name, such as "lattice-spacing"; '_' for '-' is accepted in calls.
    pub name: *const c_char,
    /// The name in the literature, such as "latticeSpacing", accepted in calls; null where there is none.
    pub alias: *const c_char,
    /// What it does.
    pub doc: *const c_char,
    /// Unit for people, such as "mm"; empty where there is none.
    pub unit: *const c_char,
    /// Heading for dialogs.
    pub group: *const c_char,
    /// The names of a choice, one a line; empty for other kinds.
    pub choices: *const c_char,
    /// Default of a text; null for other kinds and for no default.
    pub default_text: *const c_char,
    /// MW_PARAM_FLAG ... MW_PARAM_OUTPUT_FILE.
    pub kind: i32,
    /// MW_PARAM_SINGLE, MW_PARAM_PER_LABEL or MW_PARAM_REPEATABLE.
    pub multiplicity: i32,
    /// 1 where there is a default, 0 where not.
    pub has_default: i32,
    /// 1 where `min` itself is not allowed.
    pub min_excluded: i32,
    /// Default of a flag, a number or the position of a choice.
    pub default_value: f64,
    /// Smallest value.
    pub min: f64,
    /// Largest value; may be infinite.
    pub max: f64,
}

const PARAM_INFO_SIZE: usize = size_of::<mw_param_info>();

struct Row {
    name: CString,
    alias: Option<CString>,
    doc: CString,
    unit: CString,
    group: CString,
    choices: CString,
    default_text: Option<CString>,
    parameter: &'static Parameter,
}

impl Row {
    fn new(parameter: &'static Parameter) -> Self {
        Self {
            name: to_c_string(parameter.name),
            alias: parameter.alias.map(to_c_string),
            doc: to_c_string(parameter.doc),
            unit: to_c_string(parameter.unit),
            group: to_c_string(parameter.group),
            choices: match parameter.kind {
                Kind::Choice(choices) => to_c_string(&choices.join("\n")),
                _ => CString::default(),
            },
            default_text: match parameter.default {
                Default::Text(text) => Some(to_c_string(text)),
                _ => None,
            },
            parameter,
        }
    }

    fn info(&self) -> mw_param_info {
        let optional = |text: &Option<CString>| text.as_ref().map_or(std::ptr::null(), |t| t.as_ptr());
        let (kind, min, max, open) = kind_of(self.parameter.kind);
        mw_param_info {
            struct_size: PARAM_INFO_SIZE,
            name: self.name.as_ptr(),
            alias: optional(&self.alias),
            doc: self.doc.as_ptr(),
            unit: self.unit.as_ptr(),
            group: self.group.as_ptr(),
            choices: self.choices.as_ptr(),
            default_text: optional(&self.default_text),
            kind,
            multiplicity: match self.parameter.multiplicity {
                Multiplicity::Single => MW_PARAM_SINGLE,
                Multiplicity::PerLabel => MW_PARAM_PER_LABEL,
                Multiplicity::Repeatable => MW_PARAM_REPEATABLE,
            },
            has_default: i32::from(self.parameter.default != Default::Unset),
            min_excluded: i32::from(open),
            default_value: match self.parameter.default {
                Default::Flag(value) => f64::from(u8::from(value)),
                Default::Integer(value) => value as f64,
                Default::Real(value) => value,
                Default::Unset | Default::Text(_) => 0.0,
            },
            min,
            max,
        }
    }
}

/// Number, range and whether the lower bound is excluded.
fn kind_of(kind: Kind) -> (i32, f64, f64, bool) {
    match kind {
        Kind::Flag => (MW_PARAM_FLAG, 0.0, 1.0, false),
        Kind::Integer { min, max } => (MW_PARAM_INTEGER, min as f64, max as f64, false),
        Kind::Real { min, max, open_min } => (MW_PARAM_REAL, min, max, open_min),
        Kind::Choice(choices) => (MW_PARAM_CHOICE, 0.0, choices.len() as f64 - 1.0, false),
        Kind::Text => (MW_PARAM_TEXT, 0.0, 0.0, false),
        Kind::InputFile { .. } => (MW_PARAM_INPUT_FILE, 0.0, 0.0, false),
        Kind::OutputFile { .. } => (MW_PARAM_OUTPUT_FILE, 0.0, 0.0, false),
    }
}

fn rows(kind: i32) -> Result<&'static [Row]> {
    static TABLES: [OnceLock<Vec<Row>>; JobKind::ALL.len()] = [const { OnceLock::new() }; JobKind::ALL.len()];
    let kind = JobKind::from_number(kind)?;
    Ok(TABLES[kind as usize - 1].get_or_init(|| kind.parameters().iter().map(Row::new).collect()))
}

/// Number of parameters of a kind of job.
///
/// @param kind  MW_JOB_...
/// @param out   receives the number
/// @return MW_OK, MW_E_ARG (null pointer, unknown kind)
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_param_count(kind: i32, out: *mut i32) -> mw_status {
    // SAFETY: the C caller's promise about `out`.
    guard(|| unsafe { write(out, rows(kind)?.len() as i32, "out") })
}

/// Describes a parameter of a kind of job. The command line's options, the XML for 3D Slicer and this list come from
/// one table.
///
/// @param kind   MW_JOB_...
/// @param index  from 0
/// @param out    receives the description; set its struct_size before
/// @return MW_OK, MW_E_ARG (null pointer, unknown kind, index out of range, struct_size too small)
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mw_param_get(kind: i32, index: i32, out: *mut mw_param_info) -> mw_status {
    guard(|| {
        let rows = rows(kind)?;
        let row = usize::try_from(index).ok().and_then(|index| rows.get(index));
        let row = row.ok_or_else(|| Error::argument("index", format!("{index} of {}", rows.len())))?;
        // SAFETY: the C caller's promise about the struct.
        unsafe { write_sized(out, &row.info(), PARAM_INFO_SIZE, "out") }
    })
}
