//! Exit codes: one per kind of failure, so that scripts need not read the message.

use meshwright::Error;

/// Wrong usage: an unknown option, a value out of range, a file ending that cannot be written.
pub const USAGE: u8 = 2;
/// The input is invalid.
pub const INPUT: u8 = 3;
/// No mesh or field could be made from valid input.
pub const NO_RESULT: u8 = 4;
/// Reading or writing failed.
pub const FILES: u8 = 5;
/// A limit was reached: memory, time, number of elements.
pub const LIMIT: u8 = 6;
/// Interrupted.
pub const INTERRUPTED: u8 = 130;

/// The exit code of an error.
pub fn of(error: &Error) -> u8 {
    match error {
        Error::UnknownParameter { .. }
        | Error::ParameterValue { .. }
        | Error::InvalidArgument { .. }
        | Error::Unsupported { .. } => USAGE,
        Error::InvalidInput { .. } | Error::Format { .. } => INPUT,
        Error::Io { .. } => FILES,
        Error::CapacityExceeded { .. } | Error::OutOfMemory { .. } | Error::LimitReached { .. } => LIMIT,
        Error::Cancelled => INTERRUPTED,
        _ => NO_RESULT,
    }
}
