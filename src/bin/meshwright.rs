//! The command line: parses, calls the pipeline, writes; no algorithm.

fn main() {}
