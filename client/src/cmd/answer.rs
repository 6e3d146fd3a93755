//! What commands answer, on standard output, and what they say beside that, on standard error.

use super::failure::Failure;
use std::fmt::Arguments;
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

/// Says a line on standard error, to whoever reads that; nobody has to.
pub(crate) fn note(line: Arguments<'_>) {
    let _ = writeln!(io::stderr().lock(), "{line}");
}
