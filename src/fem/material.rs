//! Isotropic linear-elastic materials, one per label.
//!
//! # Method
//! Young's modulus and Poisson's ratio give the Lame constants of Hooke's law.
//!
//! # Invariants
//! A [`Material`] is finite, its modulus positive, its ratio in (-1, 0.5): the stiffness is positive definite.

use crate::error::{Error, Result};

/// An isotropic linear-elastic material.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Material {
    young_modulus: f64,
    poisson_ratio: f64,
}

impl Material {
    /// Young's modulus (any unit of pressure, the same for all materials of a model) and Poisson's ratio.
    ///
    /// # Errors
    /// [`Error::InvalidArgument`] for a modulus that is not positive and finite, or a ratio outside (-1, 0.5): at 0.5
    /// a body is incompressible and has no finite stiffness.
    pub fn new(young_modulus: f64, poisson_ratio: f64) -> Result<Self> {
        if !(young_modulus > 0.0 && young_modulus.is_finite()) {
            return Err(Error::argument("Young's modulus", format!("{young_modulus} is not positive and finite")));
        }
        if !(poisson_ratio > -1.0 && poisson_ratio < 0.5) {
            return Err(Error::argument("Poisson's ratio", format!("{poisson_ratio} is outside (-1, 0.5)")));
        }
        Ok(Self { young_modulus, poisson_ratio })
    }

    /// Young's modulus.
    pub fn young_modulus(&self) -> f64 {
        self.young_modulus
    }

    /// Poisson's ratio.
    pub fn poisson_ratio(&self) -> f64 {
        self.poisson_ratio
    }

    /// The Lame constants (lambda, mu).
    pub fn lame(&self) -> (f64, f64) {
        let (e, nu) = (self.young_modulus, self.poisson_ratio);
        (e * nu / ((1.0 + nu) * (1.0 - 2.0 * nu)), e / (2.0 * (1.0 + nu)))
    }
}

/// Materials by caller's label.
#[derive(Debug, Clone, PartialEq)]
pub struct MaterialMap {
    default: Option<Material>,
    entries: Vec<(i32, Material)>,
}

impl MaterialMap {
    /// One material for every label.
    pub fn uniform(material: Material) -> Self {
        Self { default: Some(material), entries: Vec::new() }
    }

    /// The listed materials; `default` for other labels, where it is given.
    pub fn new(default: Option<Material>, mut entries: Vec<(i32, Material)>) -> Self {
        entries.sort_by_key(|(label, _)| *label);
        Self { default, entries }
    }

    /// The material of a label.
    ///
    /// # Errors
    /// [`Error::InvalidArgument`] naming a label without material.
    pub fn of(&self, label: i32) -> Result<Material> {
        self.entries
            .binary_search_by_key(&label, |(l, _)| *l)
            .ok()
            .map(|at| self.entries[at].1)
            .or(self.default)
            .ok_or_else(|| Error::argument("materials", format!("label {label} has no material")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_incompressible_material_is_refused() {
        assert!(Material::new(1.0, 0.5).is_err());
        assert!(Material::new(0.0, 0.3).is_err());
        assert!(Material::new(f64::NAN, 0.3).is_err());
        let (lambda, mu) = Material::new(2.5, 0.25).unwrap().lame();
        assert!((lambda - 1.0).abs() < 1e-15 && (mu - 1.0).abs() < 1e-15);
    }

    #[test]
    fn a_label_without_material_is_named() {
        let stiff = Material::new(10.0, 0.3).unwrap();
        let map = MaterialMap::new(None, vec![(7, stiff)]);
        assert_eq!(map.of(7).unwrap(), stiff);
        assert!(map.of(8).unwrap_err().to_string().contains('8'));
    }
}
