//! The `pbgi-worker` program: started by the daemon, shades tiles until its sockets close.
#![forbid(unsafe_code)]

use clap::Parser;
use pbgi_worker::{Options, WorkerError};
use std::process::ExitCode;

fn main() -> ExitCode {
    // First of all: a daemon that dies from here on takes this process with it.
    if let Err(error) = pbgi_worker::die_with_parent() {
        return fail(&error);
    }
    let options = Options::parse();
    pbgi_worker::init_tracing();
    match pbgi_worker::run(&options) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => fail(&error),
    }
}

fn fail(error: &WorkerError) -> ExitCode {
    eprintln!("pbgi-worker: {error}");
    ExitCode::from(error.exit_code())
}
