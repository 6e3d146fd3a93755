//! What commands answer, on standard output.

use super::failure::Failure;
use std::io::{self, Write};

/// Prints a text that ends a line. A reader who has seen enough and gone, as `head` does, is no failure.
pub(crate) fn say(text: &str) -> Result<(), Failure> {
    let mut out = io::stdout().lock();
    let end = if text.is_empty() || text.ends_with('\n') {
        ""
    } else {
        "\n"
    };
    let said = write!(out, "{text}{end}").and_then(|()| out.flush());
    match said {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => {
            Err(Failure::failed(format!("cannot write the answer: {error}")))
        }
        _ => Ok(()),
    }
}
