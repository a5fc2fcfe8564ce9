//! Segmented image to mesh by adaptive body-centred cubic lattice refinement (CBC3D).
