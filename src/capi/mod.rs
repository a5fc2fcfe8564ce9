//! The C boundary: converts and calls, no algorithm.
