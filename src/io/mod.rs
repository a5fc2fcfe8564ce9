//! Files: thin adapters over well-kept crates where one exists, own code only for formats without one.
