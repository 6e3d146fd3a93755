//! The `pbgi-client` command line: reads the arguments, runs one command, turns its end into an exit code.
//!
//! Exit codes: 0 done, 1 failed, 2 wrong usage, 130 interrupted.
#![forbid(unsafe_code)]

mod cmd;

use clap::Parser;
use std::process::ExitCode;

fn main() -> ExitCode {
    cmd::run(cmd::Arguments::parse())
}
