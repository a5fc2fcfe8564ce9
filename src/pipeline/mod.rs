//! Composes engines: the only Rust code that knows two of them.
