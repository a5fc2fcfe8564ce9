//! Tests of the option table and its lists.

use super::*;

#[test]
fn defaults_are_the_tables() {
    let options = Options::default();
    assert!(options.refine && options.boundary_recovery == RecoveryMode::Full);
    assert_eq!((options.size_factor, options.growth_rate, options.quality_passes), (1.2, 1.1, 2));
}

#[test]
fn names_and_aliases_are_unique_and_defaults_in_range() {
    let mut names: Vec<&str> = PARAMETERS.iter().flat_map(|p| std::iter::once(p.name).chain(p.alias)).collect();
    names.sort_unstable();
    let count = names.len();
    names.dedup();
    assert_eq!(names.len(), count);
    for parameter in PARAMETERS {
        if let Some(value) = parameter.default_value() {
            parameter.check(value).unwrap();
        }
    }
}

#[test]
fn options_without_effect_accept_their_default_only() {
    for name in FIXED {
        let parameter = &PARAMETERS[crate::parameters::find(PARAMETERS, name).unwrap()];
        let default = parameter.default_value().unwrap();
        let other = match default {
            Value::Flag(flag) => Value::Flag(!flag),
            Value::Integer(number) => Value::Integer(number + 1),
            Value::Real(number) => Value::Real(number + 1.0),
            _ => unreachable!(),
        };
        let mut set = ParameterSet::new(PARAMETERS);
        set.set(name, default).unwrap();
        assert!(Options::from_parameters(&set).is_ok(), "{name}");
        set.set(name, other).unwrap();
        assert!(matches!(Options::from_parameters(&set), Err(Error::ParameterValue { .. })), "{name}");
    }
}

#[test]
fn lists_are_read_or_refused() {
    let mut set = ParameterSet::new(PARAMETERS);
    set.set_text("hole", "1,2,3").unwrap();
    set.set_text("region", "0,0,0,7,0.5").unwrap();
    set.set_text("size-source", "box:1,1,1,0,0,0,0.1").unwrap();
    set.set_text("patch-role", "3=transparent").unwrap();
    let options = Options::from_parameters(&set).unwrap();
    assert_eq!(options.holes, [DVec3::new(1.0, 2.0, 3.0)]);
    assert_eq!((options.regions[0].label, options.regions[0].size), (7, Some(0.5)));
    assert_eq!(options.patch_roles, [(3, "embedded".to_owned())]);
    for (name, text) in [
        ("hole", "1,2"),
        ("hole", "1,2,nan"),
        ("region", "0,0,0,0"),
        ("region", "0,0,0,1,-1"),
        ("region", "0,0,0,1.5"),
        ("size-source", "point:0,0,0,0"),
        ("size-source", "sphere:0,0,0,-1,1"),
        ("size-source", "cone:0,0,0"),
        ("patch-role", "x=wall"),
        ("patch-role", "1=roof"),
    ] {
        let mut set = ParameterSet::new(PARAMETERS);
        set.set_text(name, text).unwrap();
        assert!(matches!(Options::from_parameters(&set), Err(Error::ParameterValue { .. })), "{name} {text}");
    }
}
