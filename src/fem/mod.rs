//! Finite elements: linear elasticity on tets, pyramids, wedges and hexahedra, and the displacement fit.
