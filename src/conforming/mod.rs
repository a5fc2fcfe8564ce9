//! Surface triangulation to tetrahedra that keep the surface exactly (CDT3D).
