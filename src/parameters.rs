//! The parameter table: one description per option, from which everything else is made.
//!
//! # Method
//! Each engine owns ONE static table of [`Parameter`]s. A [`ParameterSet`] holds the values a caller gave, checked
//! against the table when they are set. The engine turns the set into its plain options struct once, at its entry.
//! The C setters and introspection, the command line's flags and help, Slicer's XML and the reference page are all
//! made from the same table.
//!
//! # Invariants
//! A value in a [`ParameterSet`] is of the table's kind and within its range. Unknown names are errors that name the
//! nearest known one; nothing is silently ignored.

use crate::error::{Error, Result};

/// What kind of value a parameter takes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Kind {
    /// On or off; `0`, `1`, `true`, `false`, `yes`, `no`, `on`, `off` as text.
    Flag,
    /// A whole number within the inclusive range.
    Integer {
        /// Smallest allowed.
        min: i64,
        /// Largest allowed.
        max: i64,
    },
    /// A finite number within the range; an open end excludes the bound itself.
    Real {
        /// Lower bound.
        min: f64,
        /// Upper bound; may be infinite (the value itself never is).
        max: f64,
        /// Whether `min` itself is excluded.
        open_min: bool,
    },
    /// One of the named choices; the thesis's number for a choice is its position.
    Choice(&'static [&'static str]),
    /// Free text, such as a list; the engine says which form.
    Text,
    /// A file to read.
    InputFile {
        /// Extensions, with the dot, for file dialogs.
        extensions: &'static [&'static str],
    },
    /// A file to write.
    OutputFile {
        /// Extensions, with the dot, for file dialogs.
        extensions: &'static [&'static str],
    },
}

/// A default or a given value.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// For [`Kind::Flag`].
    Flag(bool),
    /// For [`Kind::Integer`], and the position for [`Kind::Choice`].
    Integer(i64),
    /// For [`Kind::Real`].
    Real(f64),
    /// For text and files.
    Text(String),
}

/// The default of a parameter, in a form that a static table can hold.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Default {
    /// Nothing: the parameter is unset unless given.
    Unset,
    /// For [`Kind::Flag`].
    Flag(bool),
    /// For [`Kind::Integer`] and the position for [`Kind::Choice`].
    Integer(i64),
    /// For [`Kind::Real`].
    Real(f64),
    /// For text and files.
    Text(&'static str),
}

/// How often, and for what, a parameter can be given.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Multiplicity {
    /// Once; a later value replaces an earlier one.
    Single,
    /// Once for all labels, and once per label (`--fidelity-for 3=0.9` on the command line; `..._for` in C).
    PerLabel,
    /// Any number of times; the values form a list (`--hole`, `--region`).
    Repeatable,
}

/// One row of an engine's table.
#[derive(Debug, Clone, Copy)]
pub struct Parameter {
    /// Canonical name, lower case with hyphens: `lattice-spacing`.
    pub name: &'static str,
    /// The thesis's name where it has one: `latticeSpacing`.
    pub alias: Option<&'static str>,
    /// What it takes, with the range.
    pub kind: Kind,
    /// Value when not given.
    pub default: Default,
    /// Unit for people: `mm`, `N/mm^2`, `degrees`, `voxels`; empty where there is none.
    pub unit: &'static str,
    /// How often it can be given.
    pub multiplicity: Multiplicity,
    /// Heading it stands under in help, XML and reference.
    pub group: &'static str,
    /// One or two sentences for a user: what it does and when to change it.
    pub doc: &'static str,
}

/// The whole table of an engine.
pub type Table = &'static [Parameter];

/// Values given by a caller, checked against a table.
#[derive(Debug, Clone)]
pub struct ParameterSet {
    table: Table,
    values: Vec<Vec<Value>>,
    per_label: Vec<Vec<(i64, Value)>>,
}

/// Position of `name` in `table`: canonical name, thesis's alias, or with `_` for `-`.
///
/// # Errors
/// [`Error::UnknownParameter`] with the nearest known name.
pub fn find(table: Table, name: &str) -> Result<usize> {
    let plain = name.trim_start_matches('-').replace('_', "-");
    table
        .iter()
        .position(|p| p.name == plain || p.alias.is_some_and(|a| a == name.trim_start_matches('-') || a == plain))
        .ok_or_else(|| Error::UnknownParameter { name: name.to_owned(), nearest: nearest_name(table, &plain) })
}

fn nearest_name(table: Table, name: &str) -> Option<String> {
    let names = table.iter().flat_map(|p| std::iter::once(p.name).chain(p.alias));
    let (distance, best) = names.map(|n| (edit_distance(&n.to_lowercase(), &name.to_lowercase()), n)).min()?;
    // Past a third of its letters a name is another name, not a slip.
    (distance * 3 <= best.len().max(name.len())).then(|| best.to_owned())
}

/// Levenshtein distance.
fn edit_distance(left: &str, right: &str) -> usize {
    let right: Vec<char> = right.chars().collect();
    let mut row: Vec<usize> = (0..=right.len()).collect();
    for (i, l) in left.chars().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, r) in right.iter().enumerate() {
            let substituted = diagonal + usize::from(l != *r);
            diagonal = row[j + 1];
            row[j + 1] = substituted.min(row[j] + 1).min(row[j + 1] + 1);
        }
    }
    row[right.len()]
}

impl Parameter {
    /// Parses `text` as a value of this parameter.
    ///
    /// # Errors
    /// [`Error::ParameterValue`] for the wrong kind or a value out of range.
    pub fn parse(&self, text: &str) -> Result<Value> {
        let text = text.trim();
        let value = match self.kind {
            Kind::Flag => match text.to_lowercase().as_str() {
                "1" | "true" | "yes" | "on" => Value::Flag(true),
                "0" | "false" | "no" | "off" => Value::Flag(false),
                _ => return Err(self.refuse(format!("'{text}' is neither on nor off"))),
            },
            Kind::Integer { .. } => {
                Value::Integer(text.parse().map_err(|_| self.refuse(format!("'{text}' is not a whole number")))?)
            }
            Kind::Real { .. } => {
                Value::Real(text.parse().map_err(|_| self.refuse(format!("'{text}' is not a number")))?)
            }
            Kind::Choice(choices) => match choices.iter().position(|c| *c == text) {
                Some(position) => Value::Integer(position as i64),
                None => Value::Integer(
                    text.parse().map_err(|_| self.refuse(format!("'{text}' is none of {}", choices.join(", "))))?,
                ),
            },
            Kind::Text | Kind::InputFile { .. } | Kind::OutputFile { .. } => Value::Text(text.to_owned()),
        };
        self.check(value)
    }

    /// Checks kind and range of `value`; whole numbers are accepted for reals and flags.
    ///
    /// # Errors
    /// [`Error::ParameterValue`].
    pub fn check(&self, value: Value) -> Result<Value> {
        match (self.kind, value) {
            (Kind::Flag, Value::Flag(v)) => Ok(Value::Flag(v)),
            (Kind::Flag, Value::Integer(v @ 0..=1)) => Ok(Value::Flag(v == 1)),
            (Kind::Integer { min, max }, Value::Integer(v)) if (min..=max).contains(&v) => Ok(Value::Integer(v)),
            (Kind::Integer { min, max }, Value::Integer(v)) => {
                Err(self.refuse(format!("{v} is outside [{min}, {max}]")))
            }
            (Kind::Real { .. }, Value::Integer(v)) => self.check(Value::Real(v as f64)),
            (Kind::Real { min, max, open_min }, Value::Real(v)) => {
                let above = if open_min { v > min } else { v >= min };
                if v.is_finite() && above && v <= max {
                    Ok(Value::Real(v))
                } else {
                    let open = if open_min { '(' } else { '[' };
                    Err(self.refuse(format!("{v} is outside {open}{min}, {max}]")))
                }
            }
            (Kind::Choice(choices), Value::Integer(v)) if v >= 0 && (v as usize) < choices.len() => {
                Ok(Value::Integer(v))
            }
            (Kind::Choice(choices), Value::Integer(v)) => {
                Err(self.refuse(format!("{v} is none of 0 to {} ({})", choices.len() - 1, choices.join(", "))))
            }
            (Kind::Text | Kind::InputFile { .. } | Kind::OutputFile { .. }, Value::Text(v)) => Ok(Value::Text(v)),
            (_, Value::Text(v)) => self.parse(&v),
            (kind, value) => Err(self.refuse(format!("{value:?} is not of the kind {kind:?}"))),
        }
    }

    /// The default as a value.
    pub fn default_value(&self) -> Option<Value> {
        match self.default {
            Default::Unset => None,
            Default::Flag(v) => Some(Value::Flag(v)),
            Default::Integer(v) => Some(Value::Integer(v)),
            Default::Real(v) => Some(Value::Real(v)),
            Default::Text(v) => Some(Value::Text(v.to_owned())),
        }
    }

    fn refuse(&self, reason: String) -> Error {
        Error::ParameterValue { name: self.name.to_owned(), reason }
    }
}

impl ParameterSet {
    /// No value given yet.
    pub fn new(table: Table) -> Self {
        Self { table, values: vec![Vec::new(); table.len()], per_label: vec![Vec::new(); table.len()] }
    }

    /// The table the values are checked against.
    pub fn table(&self) -> Table {
        self.table
    }

    /// Gives a value; repeatable parameters collect them.
    ///
    /// # Errors
    /// [`Error::UnknownParameter`], [`Error::ParameterValue`].
    pub fn set(&mut self, name: &str, value: Value) -> Result<()> {
        let row = find(self.table, name)?;
        let value = self.table[row].check(value)?;
        if self.table[row].multiplicity != Multiplicity::Repeatable {
            self.values[row].clear();
        }
        self.values[row].push(value);
        Ok(())
    }

    /// Gives a value as text.
    ///
    /// # Errors
    /// As [`ParameterSet::set`].
    pub fn set_text(&mut self, name: &str, text: &str) -> Result<()> {
        self.set(name, Value::Text(text.to_owned()))
    }

    /// Gives a value for one label.
    ///
    /// # Errors
    /// As [`ParameterSet::set`]; [`Error::ParameterValue`] for a parameter that is not per label.
    pub fn set_for_label(&mut self, name: &str, label: i64, value: Value) -> Result<()> {
        let row = find(self.table, name)?;
        let parameter = &self.table[row];
        if parameter.multiplicity != Multiplicity::PerLabel {
            return Err(parameter.refuse("it cannot be given per label".into()));
        }
        let value = parameter.check(value)?;
        self.per_label[row].retain(|(l, _)| *l != label);
        self.per_label[row].push((label, value));
        self.per_label[row].sort_by_key(|(l, _)| *l);
        Ok(())
    }

    /// Whether a value was given.
    pub fn is_set(&self, name: &str) -> bool {
        find(self.table, name).is_ok_and(|row| !self.values[row].is_empty())
    }

    /// The given value, or the default, or `None` for an unset parameter without default.
    ///
    /// # Panics
    /// When the engine asks for a name its own table lacks: our bug.
    pub fn value(&self, name: &str) -> Option<Value> {
        let row = self.row(name);
        self.values[row].last().cloned().or_else(|| self.table[row].default_value())
    }

    /// All values of a repeatable parameter, in the order given.
    ///
    /// # Panics
    /// As [`ParameterSet::value`].
    pub fn values(&self, name: &str) -> &[Value] {
        &self.values[self.row(name)]
    }

    /// Values given per label, sorted by label.
    ///
    /// # Panics
    /// As [`ParameterSet::value`].
    pub fn label_values(&self, name: &str) -> &[(i64, Value)] {
        &self.per_label[self.row(name)]
    }

    /// A real parameter with a default.
    ///
    /// # Panics
    /// When the table says otherwise: our bug.
    pub fn real(&self, name: &str) -> f64 {
        self.optional_real(name).unwrap_or_else(|| panic!("parameter {name} has no real value"))
    }

    /// A real parameter that may be unset.
    ///
    /// # Panics
    /// When the table says it is not a real: our bug.
    pub fn optional_real(&self, name: &str) -> Option<f64> {
        self.value(name).map(|v| match v {
            Value::Real(v) => v,
            other => panic!("parameter {name} is no real: {other:?}"),
        })
    }

    /// An integer parameter, or the position of a choice, with a default.
    ///
    /// # Panics
    /// When the table says otherwise: our bug.
    pub fn integer(&self, name: &str) -> i64 {
        match self.value(name) {
            Some(Value::Integer(v)) => v,
            other => panic!("parameter {name} is no integer: {other:?}"),
        }
    }

    /// A flag with a default.
    ///
    /// # Panics
    /// When the table says otherwise: our bug.
    pub fn flag(&self, name: &str) -> bool {
        match self.value(name) {
            Some(Value::Flag(v)) => v,
            other => panic!("parameter {name} is no flag: {other:?}"),
        }
    }

    /// Text or a file name; `None` where unset.
    ///
    /// # Panics
    /// When the table says otherwise: our bug.
    pub fn text(&self, name: &str) -> Option<String> {
        self.value(name).map(|v| match v {
            Value::Text(v) => v,
            other => panic!("parameter {name} is no text: {other:?}"),
        })
    }

    fn row(&self, name: &str) -> usize {
        find(self.table, name).unwrap_or_else(|_| panic!("parameter {name} is not in the table"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TABLE: Table = &[
        Parameter {
            name: "lattice-spacing",
            alias: Some("latticeSpacing"),
            kind: Kind::Real { min: 0.1, max: f64::INFINITY, open_min: false },
            default: Default::Real(8.0),
            unit: "mm",
            multiplicity: Multiplicity::Single,
            group: "Lattice",
            doc: "",
        },
        Parameter {
            name: "fidelity",
            alias: None,
            kind: Kind::Real { min: 0.0, max: 1.0, open_min: true },
            default: Default::Real(0.8),
            unit: "",
            multiplicity: Multiplicity::PerLabel,
            group: "Lattice",
            doc: "",
        },
    ];

    #[test]
    fn both_spellings_name_the_same_parameter() {
        for name in ["lattice-spacing", "lattice_spacing", "latticeSpacing", "--lattice-spacing"] {
            assert_eq!(find(TABLE, name).unwrap(), 0);
        }
    }

    #[test]
    fn an_unknown_name_suggests_the_nearest() {
        let Err(Error::UnknownParameter { nearest, .. }) = find(TABLE, "fidelty") else { panic!() };
        assert_eq!(nearest.as_deref(), Some("fidelity"));
    }

    #[test]
    fn values_out_of_range_are_refused() {
        let mut set = ParameterSet::new(TABLE);
        for bad in ["0", "1.5", "nan", "inf", "x"] {
            assert!(set.set_text("fidelity", bad).is_err(), "{bad}");
        }
        assert!(set.set_text("fidelity", "1").is_ok());
        assert!(set.set_for_label("latticeSpacing", 3, Value::Real(2.0)).is_err());
        assert!(set.set_for_label("fidelity", 3, Value::Real(0.5)).is_ok());
        assert_eq!(set.label_values("fidelity"), &[(3, Value::Real(0.5))]);
    }
}
