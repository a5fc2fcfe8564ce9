//! Finite elements: linear elasticity on tets, pyramids, wedges and hexahedra, and the displacement fit.

pub mod assembly;
pub mod constraints;
pub mod displacement_fit;
pub mod element_mesh;
pub mod element_stiffness;
pub mod linear_elasticity;
pub mod material;
pub mod point_interpolation;
pub mod quadrature;
pub mod shape_functions;
